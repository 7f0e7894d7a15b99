//! The same seed gives the same run, whoever evaluates it.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::fs;

use quad_protocol::Hash;
use quad_tests::PATIENCE;
use quad_tests::system::{Scratch, Setting};

type Outcome = (Vec<Hash>, Vec<(u64, u64, u64, u64)>);

/// The snapshots' hashes, and of each episode step, seed, length and the bits of its return.
fn outcome(run: &str, setting: Setting, evaluators: usize) -> Outcome {
    let scratch = Scratch::new();
    let mut learner = scratch.learner(run, setting);
    let endpoint = learner.endpoint();
    let _evaluators: Vec<_> =
        (0..evaluators).map(|i| scratch.evaluator(&format!("evaluator-{i}"), &endpoint)).collect();
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&setting);
    let hash = |step: u64| Hash::of(&fs::read(learner.snapshot(step)).unwrap());
    let mut episodes: Vec<_> = learner
        .scores()
        .iter()
        .map(|score| (score.key().0, score.key().1, score.integer("length"), score.number("return").to_bits()))
        .collect();
    episodes.sort_unstable();
    (setting.evaluated_steps().into_iter().map(hash).collect(), episodes)
}

#[test]
fn a_seed_fixes_weights_and_scores() {
    let setting = Setting { hidden: 64, candidates: 10, ..Setting::default() };
    let first = outcome("first", setting, 1);
    let again = outcome("again", setting, 2);
    assert_eq!(first, again, "the same seed");
    let other = outcome("other", Setting { seed: 2, ..setting }, 1);
    assert!(first.0.iter().zip(&other.0).all(|(a, b)| a != b), "another seed gives other weights");
}
