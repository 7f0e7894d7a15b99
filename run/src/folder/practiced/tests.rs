//! Tests of what `learner verify` says of experience.

use quad_protocol::{Episode, EpisodeScore, Name, Record};

use super::*;
use crate::config::resolve;
use crate::fixtures::config;

/// The first practice episodes of a run of seed 0, of two steps each.
fn records<const N: usize>() -> [Record; N] {
    let name = |text: &str| Name::new(text).unwrap();
    std::array::from_fn(|number| {
        let seed = practice_seed(0, number as u64);
        let episode = Episode {
            step: 10,
            weights: Hash::of(b"weights"),
            score: EpisodeScore { seed, episode_return: 3.0, length: 2, score: 3.0 },
            terminated: true,
            observations: vec![0.0, 1.0, 2.0],
            actions: vec![0.5, -0.5],
            rewards: vec![1.0, 2.0],
            interventions: Vec::new(),
        };
        Record { evaluator: name("e"), precision: name("f32-avx2"), episode }
    })
}

/// Findings on a run of four environment steps with these records.
fn verified(records: &[Record]) -> (String, &'static str) {
    let folder = tempfile::tempdir().unwrap();
    let mut config = config("a", 0);
    let online = "online = { steps = 4, warmup = 0, lag = 2 }".parse().unwrap();
    config.experiment.online = resolve("hopper-demo", &online).unwrap().online;
    let (run, _) = RunDir::create(&folder.path().join("a"), &config).unwrap();
    run.write_snapshot(10, b"weights").unwrap();
    run.experience_log().unwrap().0.append(records).unwrap();
    let (findings, promise) = practiced(run.path()).unwrap().unwrap();
    (findings.to_string(), promise)
}

#[test]
fn a_run_without_practice_promises_nothing_of_it() {
    let folder = tempfile::tempdir().unwrap();
    let (run, _) = RunDir::create(&folder.path().join("a"), &config("a", 0)).unwrap();
    assert_eq!(practiced(run.path()).unwrap(), None);
}

#[test]
fn what_is_missing_or_strange_is_named() {
    let whole = records::<2>();
    let all = "4 of 4 environment steps are recorded";
    assert_eq!(verified(&whole), (all.to_owned(), REPEATABLE));
    let missing = "2 of 4 environment steps are recorded\nnot recorded yet (1): 2 steps";
    assert_eq!(verified(&whole[..1]).0, missing);
    let seed = whole[0].episode.score.seed;
    let [mut strange, again] = whole.clone();
    strange.episode.score.seed = 1;
    let found = verified(&[strange, again]).0;
    assert_eq!(found, format!("{all}\nno episode of this run (1): step 10, seed 1"));
    let twice = [&whole[0], &whole[0]].map(Clone::clone);
    let expected = format!("{all}\nrecorded twice (1): step 10, seed {seed}");
    assert_eq!(verified(&twice).0, expected);
}

#[test]
fn only_episodes_of_weights_and_seeds_alone_can_be_played_again() {
    let changes: [fn(&mut Record); 3] = [
        |record| record.episode.weights = Hash::of(b"other weights"),
        |record| record.episode.interventions = vec![1],
        |record| record.precision = Name::new("f32-avx512").unwrap(),
    ];
    for change in changes {
        let mut records = records::<2>();
        change(&mut records[1]);
        let (findings, promise) = verified(&records);
        assert_eq!(findings, "4 of 4 environment steps are recorded");
        assert_eq!(promise, LOGGED);
    }
}
