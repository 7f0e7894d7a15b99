//! Reports of runs: evaluations, aggregates over seeds and tasks, published scores, and figures.
//!
//! Reads run folders, which a learner may be writing, and makes text, JSON, HTML, SVG and PNG.
//! [`quad_run::results`] reads the runs and has the statistics.
//!
//! The protocol is the paper's (section 5.1 and appendix B): the score of a run is the mean of its
//! last 5 evaluations (3 where a task's published scores are), and several seeds give mean ±
//! standard deviation. With `--select best`, a run's best evaluation counts instead, and the report
//! says so. A run that is not complete has no score.
//!
//! In reading order: `groups` groups runs that differ only in their seed; `methods` aggregates them
//! over tasks; `published` makes published tables with our
//! scores; `summary` is the whole report; `figures` are its plots, which `plot` draws; `html` is the
//! report as one file.

mod figures;
mod groups;
mod html;
mod methods;
mod plot;
mod published;
mod summary;

pub(crate) use figures::{draw_all, learning_curve};
pub(crate) use html::write as write_html;
pub(crate) use summary::Report;
