//! The state machine of a run: which episodes there are, who plays them, what has come, what is on
//! the disk, and what is acknowledged. It does no input or output, has no thread and no lock, and
//! asks no clock: [`Service::handle`] takes a message or an event with its time, and returns
//! [`Order`]s. The module `live` brings the ones and does the others.
//!
//! An evaluation is a snapshot (step and hash) with a list of episode seeds. A job gives some of
//! its episodes to one evaluator under a lease, which progress extends. When the lease ends, or the
//! evaluator leaves, the learner gives these episodes to another evaluator, unless that has
//! happened too often. For each (step, seed) only the first delivered score counts, whichever
//! evaluator delivers it.
//!
//! An online episode is handed out like an evaluation's, but alone, before all others, and as often
//! as it takes. Its rows arrive in pieces.
//!
//! In reading order: `service`, `message` (what it takes and orders), `deliveries` (from their
//! arrival to their acknowledgment; those under way are a `queue`), `scoreboard` (episodes and jobs), `outcomes` (its arguments and
//! results), `episodes` (one evaluation), `open_job` (a job and its lease), `pieces` (episodes
//! that arrive in pieces), `validate` (checks of results), `refusal`, `evaluators`, `patience`;
//! `online_schedule` is training's, of online episodes and gradient steps.

mod deliveries;
mod episodes;
mod evaluators;
mod message;
mod online_schedule;
mod open_job;
mod outcomes;
mod patience;
mod pieces;
mod queue;
mod refusal;
mod scoreboard;
#[allow(clippy::module_inception)]
mod service;
#[cfg(test)]
mod tests;
mod validate;

pub use message::{Answer, Count, End, Frame, Input, Order, TryAgain};
pub use online_schedule::OnlineSchedule;
pub use outcomes::{Opening, OtherWeights};
pub use scoreboard::Rules;
pub use service::{Connected, Gauges, Service};
