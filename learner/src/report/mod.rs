//! What runs achieved: their evaluations, summaries over seeds, what is published for the same tasks, and pictures.
//!
//! Owns nothing: it reads run folders, which a learner may be writing, and gives text, JSON and SVG. It runs on the thread of
//! its caller: `learner report`, and `learner train` at the end of a run, both on the main thread. It imports `config`, `run`
//! and the list of algorithms.
//!
//! The protocol is the paper's (section 5.1 and appendix B): the score of a run is the mean of its last 5 evaluations, or of
//! those in its last 50,000 steps; several seeds give mean ± standard deviation. That of its best one counts only where a user
//! asks for it, and the report says so.
//!
//! In reading order: `run` reads a run; `seeds` puts runs together that differ in their seed alone; `published` are the
//! paper's figures, `departures` is how a run differs from what the paper ran; `lambda` is what QUAD's λ was in
//! a run; `summary` is the whole report; `plot` draws.
//! `selection`, `spread` and `table` are small parts of these.

mod departures;
mod lambda;
mod plot;
mod published;
mod run;
mod seeds;
mod selection;
mod spread;
mod summary;
mod table;

pub(crate) use plot::learning_curves;
pub(crate) use run::RunReport;
pub(crate) use selection::Select;
pub(crate) use spread::Spread;
pub(crate) use summary::Report;
pub(crate) use table::{Style, Table};
