//! The results of runs: evaluations, summaries over seeds, published figures of the same tasks, and
//! pictures.
//!
//! Owns nothing: it reads run folders, which a learner may be writing, and makes text, JSON, HTML,
//! SVG and PNG. It runs on its caller's thread: `learner report`, and `train` at the end of a run
//! call it on the main thread. [`quad_run::results`] reads the runs.
//!
//! The protocol is the paper's (section 5.1 and appendix B): the score of a run is the mean of its
//! last 5 evaluations (3 where a task's published figures are so), or of the evaluations in its
//! last 50,000 steps; several seeds give mean ± standard deviation. If the user asks for it, a
//! run's best evaluation counts instead, and the report says so. A run that is not complete has no
//! score.
//!
//! In reading order: `seeds` groups runs that differ only in their seed; `study` applies the
//! statistics to methods over tasks and seeds; `beside` makes published tables with our figures in
//! them; `summary` is the whole report; `figures` are its pictures, which `plot` draws; `html` puts
//! all of it into one file, with the commands of `remake`.

mod beside;
mod figures;
mod html;
mod plot;
mod remake;
mod seeds;
mod study;
mod summary;

pub(crate) use figures::{draw_all, of_run};
pub(crate) use html::write as write_html;
pub(crate) use summary::Report;
