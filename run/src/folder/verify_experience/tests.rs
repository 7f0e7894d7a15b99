//! Tests of what `learner verify` says of experience.

use quad_protocol::{Name, encode};

use super::*;
use crate::config::resolve;
use crate::fixtures::config;
use crate::folder::experience::tests::episode;

const COMPLETE: &str = "4 of 4 environment steps are recorded";

/// The first online episodes of a run of seed 0, of two steps each.
fn episodes() -> [Episode; 2] {
    [0, 1].map(|number| episode(online_seed(0, number)))
}

/// Findings on a run of four environment steps with these episodes.
fn verified(episodes: &[Episode]) -> (String, &'static str) {
    verified_in("hopper", episodes, true)
}

fn verified_in(
    environment: &str,
    episodes: &[Episode],
    has_snapshot: bool,
) -> (String, &'static str) {
    let folder = tempfile::tempdir().unwrap();
    let mut config = config("a", 0);
    config.experiment.environment = environment.to_owned();
    let online = "online = { steps = 4, warmup = 0, lag = 2 }".parse().unwrap();
    config.experiment.online = resolve("hopper-demo", &online).unwrap().online;
    let (run, _) = RunDir::create(&folder.path().join("a"), &config).unwrap();
    if has_snapshot {
        run.write_snapshot(10, b"weights").unwrap();
    }
    let frames = Vec::from_iter(episodes.iter().map(|episode| encode(episode).unwrap()));
    run.experience_log().unwrap().0.append(frames.iter().map(Vec::as_slice)).unwrap();
    let (findings, promise) =
        verify_experience(run.path(), |episode| episode.rewards[0] > 1e6).unwrap().unwrap();
    (findings.to_string(), promise)
}

#[test]
fn what_is_missing_or_strange_is_named() {
    let whole = episodes();
    let complete = || COMPLETE.to_owned();
    assert_eq!(verified(&whole), (complete(), REPEATABLE));
    assert_eq!(verified_in("my-robot", &whole, true), (complete(), IF_REPEATABLE));
    // It may be deleted.
    assert_eq!(verified_in("hopper", &whole, false), (complete(), REPEATABLE));
    let missing =
        "2 of 4 environment steps are recorded\nnot recorded yet (1): 2 steps, from episode 1 on";
    assert_eq!(verified(&whole[..1]).0, missing);
    let mut far = whole.clone();
    far[0].rewards[0] = 1e9;
    assert_eq!(verified(&far).0, missing.replace("episode 1", "episode 2"), "it is left out");
    let seed = whole[0].score.seed;
    // Training comes to no other after a gap, however many rows there are.
    let with = |seed| {
        let [first, mut second] = whole.clone();
        second.score.seed = seed;
        verified(&[first, second]).0
    };
    assert_eq!(with(online_seed(0, 2)), missing);
    let another = missing.replace("\n", "\nno episode of this run (1): step 10, seed 1\n");
    assert_eq!(with(1), another);
    assert_eq!(with(seed), format!("{missing}\nrecorded twice (1): step 10, seed {seed}"));
}

#[test]
fn only_episodes_of_weights_and_seeds_alone_can_be_played_again() {
    let changes: [fn(&mut Episode); 3] = [
        |episode| episode.weights = Hash::new(b"other weights"),
        |episode| episode.interventions = vec![1],
        |episode| episode.precision = Name::new("f32-avx512").unwrap(),
    ];
    for change in changes {
        let mut episodes = episodes();
        change(&mut episodes[1]);
        assert_eq!(verified(&episodes), (COMPLETE.to_owned(), LOGGED));
    }
}
