//! Where on Zenoh each message is found: everything of a run lies under `quad/<run>/`.
//!
//! | key | verb | message |
//! |---|---|---|
//! | `quad/<run>/weights` | learner publishes | [`Snapshot`](crate::Snapshot) |
//! | `quad/<run>/weights/<step>` | learner answers | nothing → [`Snapshot`](crate::Snapshot) |
//! | `quad/<run>/jobs` | learner answers | [`JobRequest`](crate::JobRequest) → [`JobReply`](crate::JobReply) |
//! | `quad/<run>/scores` | learner answers | [`ScoreReport`](crate::ScoreReport) → [`ScoreReply`](crate::ScoreReply) |
//! | `quad/<run>/progress/<evaluator>` | evaluator publishes | [`Progress`](crate::Progress) |
//! | `quad/<run>/live/learner/<incarnation>` | learner's liveliness token | |
//! | `quad/<run>/live/evaluator/<evaluator>` | evaluator's liveliness token | |
//!
//! A learner's answers, jobs and snapshots name its incarnation: an evaluator believes those of the
//! incarnation that it follows by its token, and not those of an earlier incarnation. Which peers
//! may use these keys is up to TLS and access control.

use crate::name::Name;

/// Key expression of the liveliness tokens of all runs' learners.
pub const ALL_LEARNERS: &str = "quad/*/live/learner/*";

/// The newest weights, as they are published.
pub fn weights(run: &Name) -> String {
    format!("quad/{run}/weights")
}

/// The weights after `step` gradient steps, for an evaluator that asks.
pub fn weights_at(run: &Name, step: u64) -> String {
    format!("quad/{run}/weights/{step}")
}

/// Key expression of [`weights_at`] any step.
pub fn weights_at_any_step(run: &Name) -> String {
    format!("quad/{run}/weights/*")
}

/// Where evaluators ask for work.
pub fn jobs(run: &Name) -> String {
    format!("quad/{run}/jobs")
}

/// Where evaluators deliver scores.
pub fn scores(run: &Name) -> String {
    format!("quad/{run}/scores")
}

/// How far one evaluator is.
pub fn progress(run: &Name, evaluator: &Name) -> String {
    format!("quad/{run}/progress/{evaluator}")
}

/// Key expression of the [`progress`] of all evaluators.
pub fn all_progress(run: &Name) -> String {
    format!("quad/{run}/progress/*")
}

/// The liveliness token of one incarnation of the learner.
pub fn live_learner(run: &Name, incarnation: u64) -> String {
    format!("quad/{run}/live/learner/{incarnation}")
}

/// Key expression of the tokens of all incarnations of a run's learner, and of all learners that
/// took the same name.
pub fn all_incarnations(run: &Name) -> String {
    format!("quad/{run}/live/learner/*")
}

/// An evaluator's liveliness token.
pub fn live_evaluator(run: &Name, evaluator: &Name) -> String {
    format!("quad/{run}/live/evaluator/{evaluator}")
}

/// Key expression of the tokens of all of a run's evaluators.
pub fn all_evaluators(run: &Name) -> String {
    format!("quad/{run}/live/evaluator/*")
}

/// The evaluator that a key of [`live_evaluator`] names.
pub fn evaluator_of(key: &str) -> Option<Name> {
    Name::new(within_run(key)?.1.strip_prefix("live/evaluator/")?).ok()
}

/// The run that `key` belongs to; `None` if it is no key of ours.
pub fn run_of(key: &str) -> Option<Name> {
    within_run(key).map(|(run, _)| run)
}

/// The incarnation that a key of [`live_learner`] names.
pub fn incarnation_of(key: &str) -> Option<u64> {
    let incarnation = within_run(key)?.1.strip_prefix("live/learner/")?;
    // Only as it is written: `+1` and `01` would be 1, too.
    incarnation.parse().ok().filter(|number: &u64| number.to_string() == incarnation)
}

/// The step that a key of [`weights_at`] names.
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
    fn keys_give_back_what_they_were_made_of() {
        let (run, evaluator) = (Name::new("run-1").unwrap(), Name::new("box.7").unwrap());
        for (key, step, incarnation, of) in [
            (jobs(&run), None, None, None),
            (weights(&run), None, None, None),
            (weights_at(&run, 10_000), Some(10_000), None, None),
            (live_learner(&run, 77), None, Some(77), None),
            (live_evaluator(&run, &evaluator), None, None, Some(evaluator)),
        ] {
            assert_eq!((run_of(&key), step_of(&key)), (Some(run.clone()), step), "{key}");
            assert_eq!((incarnation_of(&key), evaluator_of(&key)), (incarnation, of), "{key}");
        }
        assert_eq!(evaluator_of("quad/run-1/live/evaluator/a*b"), None);
    }

    #[test]
    fn strangers_keys_give_nothing() {
        for key in [
            "",
            "quad",
            "quad/",
            "quad//live",
            "quad/a b/live/learner/1",
            "quad/*/live/learner/1",
            "other/run/jobs",
        ] {
            assert_eq!(run_of(key), None, "{key}");
        }
        for key in [
            "quad/run/live/learner",
            "quad/run/live/learner/x",
            "quad/run/live/learner/01",
            "quad/run/live/learner/+1",
        ] {
            assert_eq!(incarnation_of(key), None, "{key}");
        }
        for key in
            ["quad/run/weights/", "quad/run/weights/x", "quad/run/weights/-1", "quad/run/jobs/1"]
        {
            assert_eq!(step_of(key), None, "{key}");
        }
    }
}
