//! What is to be scored, who has it, and what came back: the state of a run's evaluations, without any I/O.
//!
//! An evaluation is a snapshot (step and hash) with a list of episode seeds. A job hands some of its episodes to one
//! evaluator under a lease that progress extends. When the lease runs out, or the evaluator leaves, its episodes are handed
//! out again, unless that has happened too often. For each (step, seed) the first score that is delivered counts, and no
//! other, whichever evaluator delivers it.
//!
//! It runs on no thread of its own: the room `service` holds it behind a lock for microseconds. The current time is an
//! argument, so tests have a clock of their own.
//!
//! In reading order: `scoreboard`, `outcomes` (its questions and answers), `episodes` (one evaluation), `jobs` (which
//! evaluator has what until when), `validate` (which reports are accepted), `refusal` (why a message is not).

mod episodes;
mod jobs;
mod outcomes;
mod refusal;
mod scoreboard;
#[cfg(test)]
#[path = "../../tests/unit/evaluation/mod.rs"]
pub(crate) mod tests;
mod validate;

pub(crate) use outcomes::{Claim, Claimed, Earlier, HandedBack, Lost, OtherWeights};
pub(crate) use refusal::Refusal;
pub(crate) use scoreboard::{Rules, Scoreboard};
pub(crate) use validate::Validated;
