//! The results of a run, statistics of many runs, and published figures.
//!
//! In reading order: `report` has the results of a run, `read` reads them, `text` prints them,
//! `evaluation` summarizes an evaluation; `statistics` and `spread` have definitions; `published` has
//! figures of papers, `departures` the differences between a run and its authors'; `judgment` has
//! estimates without a simulator.

pub mod departures;
pub mod evaluation;
pub mod judgment;
pub mod published;
mod read;
mod report;
mod selection;
mod spread;
pub mod statistics;
mod text;

pub use judgment::{Conditions, Estimate, Judgment, Ranking};
pub use read::joined;
pub use report::RunReport;
pub use selection::Select;
pub use spread::Spread;
