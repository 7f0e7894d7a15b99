//! The results of runs: evaluations, summaries over seeds, published figures of the same tasks, and pictures.
//!
//! Owns nothing: it reads run folders, which a learner may be writing, and makes text, JSON, HTML, SVG, PNG and event files.
//! It runs on its caller's thread: `learner report`, `list`, and `train` at the end of a run call it on the main thread,
//! `tensorboard` during a run, and the page. It imports `config`, `run` and the list of algorithms.
//!
//! The protocol is the paper's (section 5.1 and appendix B): the score of a run is the mean of its last 5 evaluations, or of
//! the evaluations in its last 50,000 steps; several seeds give mean ± standard deviation. If the user asks for it, a run's
//! best evaluation counts instead, and the report says so. A run that is not complete has no score.
//!
//! In reading order: `run` reads a run; `seeds` groups runs that differ only in their seed; `statistics` has the definitions,
//! which `study` applies to methods over tasks and seeds; `published` has the paper's figures, `departures` the differences
//! between a run and the paper's, `lambda` a summary of QUAD's λ; `paper` makes the paper's tables with our figures in them;
//! `summary` is the whole report; `figures` are its pictures, which `plot` draws; `html` puts all of it into one file, with
//! the commands of `remake`. `selection`, `spread` and `table` are small parts of these. `state` is the state of a run, `list`
//! a table of all runs, `tensorboard` copies a run to an event file.

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
