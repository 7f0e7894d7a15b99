//! The results of a run: its scores, summarized; the statistics of many runs; and published
//! figures.
//!
//! In reading order: `run` reads a run, `evaluation` summarizes one of its evaluations;
//! `statistics` has the definitions; `published` has others' figures, `departures` the differences
//! between a run and its authors'; `judgment` what is known of policies without a simulator.
//! `selection` and `spread` are small parts of these.

pub mod departures;
pub mod evaluation;
pub mod judgment;
pub mod published;
pub mod run;
pub mod selection;
pub mod spread;
pub mod statistics;

pub use judgment::{Conditions, Estimate, Judgment, Ranking};
pub use run::RunReport;
pub use selection::Select;
pub use spread::Spread;
