//! Zenoh keys. Everything of a run lies under `quad/<run>/`.
//!
//! | key | verb | message |
//! |---|---|---|
//! | `quad/<run>/weights` | learner publishes | [`Snapshot`](crate::Snapshot) |
//! | `quad/<run>/weights/<step>` | learner answers | nothing → [`Snapshot`](crate::Snapshot) |
//! | `quad/<run>/jobs` | learner answers | [`JobRequest`](crate::JobRequest) → [`JobReply`](crate::JobReply) |
//! | `quad/<run>/scores` | learner answers | [`ScoreReport`](crate::ScoreReport) → [`ScoreReply`](crate::ScoreReply) |
//! | `quad/<run>/experience` | learner answers | [`Piece`](crate::Piece) → [`PieceReply`](crate::PieceReply) |
//! | `quad/<run>/progress/<evaluator>` | evaluator publishes | [`Progress`](crate::Progress) |
//! | `quad/<run>/live/learner/<incarnation>` | learner's liveliness token | |
//! | `quad/<run>/live/evaluator/<evaluator>` | evaluator's liveliness token | |
//!
//! A learner's answers, jobs and snapshots name its incarnation, the number of its start. An
//! evaluator follows one incarnation and ignores messages of earlier ones. TLS and access control
//! decide which peers may use these keys.

use std::fmt::Display;

use crate::name::Name;

/// Key expression of the liveliness tokens of all runs' learners.
pub const ALL_LEARNERS: &str = "quad/*/live/learner/*";

/// Stands for every step, evaluator or incarnation in a key expression.
pub const ANY: &str = "*";

/// The newest weights.
pub fn weights(run: &Name) -> String {
    format!("quad/{run}/weights")
}

/// The weights of a gradient step, or of [`ANY`].
pub fn weights_at(run: &Name, step: impl Display) -> String {
    format!("quad/{run}/weights/{step}")
}

/// Requests of jobs.
pub fn jobs(run: &Name) -> String {
    format!("quad/{run}/jobs")
}

/// Deliveries of scores.
pub fn scores(run: &Name) -> String {
    format!("quad/{run}/scores")
}

/// Deliveries of online episodes.
pub fn experience(run: &Name) -> String {
    format!("quad/{run}/experience")
}

/// Progress of an evaluator, or of [`ANY`].
pub fn progress(run: &Name, evaluator: impl Display) -> String {
    format!("quad/{run}/progress/{evaluator}")
}

/// Liveliness token of an incarnation of the learner. [`ANY`] also stands for other learners of the
/// same name.
pub fn live_learner(run: &Name, incarnation: impl Display) -> String {
    format!("quad/{run}/live/learner/{incarnation}")
}

/// Liveliness token of an evaluator, or of [`ANY`].
pub fn live_evaluator(run: &Name, evaluator: impl Display) -> String {
    format!("quad/{run}/live/evaluator/{evaluator}")
}

/// The evaluator in a key of [`live_evaluator`].
pub fn evaluator_of(key: &str) -> Option<Name> {
    Name::new(within_run(key)?.1.strip_prefix("live/evaluator/")?).ok()
}

/// The run of a key.
pub fn run_of(key: &str) -> Option<Name> {
    within_run(key).map(|(run, _)| run)
}

/// The incarnation in a key of [`live_learner`].
pub fn incarnation_of(key: &str) -> Option<u64> {
    let incarnation = within_run(key)?.1.strip_prefix("live/learner/")?;
    // Refuses `+1` and `01`.
    incarnation.parse().ok().filter(|number: &u64| number.to_string() == incarnation)
}

/// The step in a key of [`weights_at`].
pub fn step_of(key: &str) -> Option<u64> {
    within_run(key)?.1.strip_prefix("weights/")?.parse().ok()
}

/// The run of a key, and the rest of the key.
fn within_run(key: &str) -> Option<(Name, &str)> {
    let (run, rest) = key.strip_prefix("quad/")?.split_once('/')?;
    Some((Name::new(run).ok()?, rest))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_keys() {
        let (run, evaluator) = (Name::new("run-1").unwrap(), Name::new("box.7").unwrap());
        let (some, box7) = (Some(run.clone()), Some(evaluator.clone()));
        for (key, step, incarnation, named) in [
            (jobs(&run), None, None, None),
            (weights(&run), None, None, None),
            (weights_at(&run, 10_000), Some(10_000), None, None),
            ("quad/run-1/weights/".to_owned(), None, None, None),
            ("quad/run-1/weights/x".to_owned(), None, None, None),
            ("quad/run-1/weights/-1".to_owned(), None, None, None),
            (live_learner(&run, 77), None, Some(77), None),
            ("quad/run-1/live/learner".to_owned(), None, None, None),
            ("quad/run-1/live/learner/x".to_owned(), None, None, None),
            ("quad/run-1/live/learner/01".to_owned(), None, None, None),
            ("quad/run-1/live/learner/+1".to_owned(), None, None, None),
            (live_evaluator(&run, &evaluator), None, None, box7),
            ("quad/run-1/live/evaluator/a*b".to_owned(), None, None, None),
        ] {
            assert_eq!((run_of(&key), step_of(&key)), (some.clone(), step), "{key}");
            assert_eq!((incarnation_of(&key), evaluator_of(&key)), (incarnation, named), "{key}");
        }
        for key in ["", "quad", "quad/", "quad//live", "quad/a b/x", "quad/*/x", "other/run/jobs"] {
            assert_eq!(run_of(key), None, "{key}");
        }
    }
}
