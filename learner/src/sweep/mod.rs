//! Many runs: reads a study file, estimates its cost, and starts its learners.
//!
//! Owns the format of study files and the folder of a study, `runs/STUDY`, in which each run has
//! its own folder. The command `learner sweep` calls it on the main thread. Each run is a process
//! `learner train`, which meets the shared evaluators at a router in this process. It uses
//! `local_evaluators`, [`quad_run`] for the state of a run, and [`train`](crate::train) to measure
//! how long steps take.
//!
//! In reading order: `study` is the file, `axes` are its lists of values, `rules` say which
//! combinations, `names` what runs are called; `cost` estimates; `work` runs the learners, each a
//! `learner_process`, and `display` shows them.

mod axes;
mod cost;
mod display;
mod learner_process;
mod names;
mod rules;
mod study;
mod work;

pub(crate) use cost::Cost;
pub(crate) use learner_process::Learners;
pub(crate) use study::{PlannedRun, Study};
pub(crate) use work::{Ended, Sweep};
