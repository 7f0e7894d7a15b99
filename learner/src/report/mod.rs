//! What runs achieved: their evaluations, summaries over seeds, what is published for the same tasks, and pictures.
//!
//! Owns nothing: it reads run folders, which a learner may be writing, and gives text, JSON, HTML, SVG, PNG and event files. It
//! runs on the thread of its caller: `learner report`, `list`, and `train` at the end of a run, all on the main thread;
//! `tensorboard` during a run; and the page's. It imports `config`, `run`
//! and the list of algorithms.
//!
//! The protocol is the paper's (section 5.1 and appendix B): the score of a run is the mean of its last 5 evaluations, or of
//! those in its last 50,000 steps; several seeds give mean ± standard deviation. That of its best one counts only where a user
//! asks for it, and the report says so. A run that is not complete has no score.
//!
//! In reading order: `run` reads a run; `seeds` puts runs together that differ in their seed alone; `statistics` are
//! definitions, which `study` applies to methods over tasks and seeds; `published` are the paper's figures, `departures` is how
//! a run differs from what the paper ran, `lambda` what QUAD's λ was in a run; `paper` has the paper's tables with ours beside
//! them; `summary` is the whole report; `figures` are its pictures, which `plot` draws; `html` is all of that in one file, with
//! the commands of `remake`. `selection`, `spread` and `table` are small parts of these. `state` is how far a run is, `list`
//! says so of all runs, `tensorboard` copies a run to an event file.

mod departures;
mod figures;
mod html;
mod lambda;
pub(crate) mod list;
mod paper;
mod plot;
mod published;
mod remake;
mod run;
mod seeds;
mod selection;
mod spread;
mod state;
mod statistics;
mod study;
mod summary;
mod table;
mod tensorboard;

pub(crate) use figures::{draw_all, of_run};
pub(crate) use html::write as write_html;
pub(crate) use run::RunReport;
pub(crate) use selection::Select;
pub(crate) use spread::Spread;
pub(crate) use state::{Progress, State};
pub(crate) use summary::{Report, runs_in};
pub(crate) use table::{Style, Table};
pub(crate) use tensorboard::{Exporter, export_all};
