//! Sweeps: many runs, each a process `learner train`, and the format of study files.
//!
//! All learners meet shared evaluators at a router in this process. The folder of a study,
//! `runs/STUDY`, has a folder for each run.
//!
//! In reading order: `study` reads a file, `combinations` are those of its lists of values; `cost`
//! estimates; `scheduler` runs the learners, each a `learner_process`, and shows them.

mod combinations;
mod cost;
mod learner_process;
mod scheduler;
mod study;

pub(crate) use cost::StudyCost;
pub(crate) use learner_process::LearnerOptions;
pub(crate) use scheduler::{Outcome, Sweep};
pub(crate) use study::{PlannedRun, Study};
