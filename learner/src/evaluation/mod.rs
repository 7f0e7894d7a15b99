//! The state of a run's evaluations: episodes, jobs and scores. It does no I/O.
//!
//! An evaluation is a snapshot (step and hash) with a list of episode seeds. A job gives some of
//! its episodes to one evaluator under a lease, which progress extends. When the lease ends, or the
//! evaluator leaves, the learner gives these episodes to another evaluator, unless that has
//! happened too often. For each (step, seed) only the first delivered score counts, whichever
//! evaluator delivers it.
//!
//! A practice episode is handed out like an evaluation's, but alone, before all others, and as often
//! as it takes.
//!
//! It has no thread: the module `live` calls it behind a lock, for microseconds. The current time
//! is an argument, so tests have a clock of their own.
//!
//! In reading order: `scoreboard`, `outcomes` (its arguments and results), `episodes` (one
//! evaluation), `open_job` (a job and its lease), `validate` (checks of reports), `refusal`.

mod episodes;
mod open_job;
mod outcomes;
mod refusal;
mod scoreboard;
#[cfg(test)]
mod tests;
mod validate;

pub(crate) use outcomes::{Claim, Claimed, Lost, Opening, OtherWeights, PracticeEpisode};
pub(crate) use refusal::Refusal;
pub(crate) use scoreboard::{Rules, Scoreboard};
pub(crate) use validate::Validated;
