//! The results of a run, statistics of many runs, and published figures.
//!
//! In reading order: `report` has the results of a run, `read` reads them, `text` prints them;
//! `statistics` has definitions; `published` has figures of papers, `departures` the differences between
//! a run and its authors'; `judgment` has estimates without a simulator.

pub mod departures;
pub mod judgment;
pub mod published;
mod read;
mod report;
pub mod statistics;
mod text;

pub use judgment::{Conditions, Estimate, Judgment, Ranking};
pub use read::joined;
pub use report::{EvaluationReport, RunReport, Select};
pub use statistics::Spread;
