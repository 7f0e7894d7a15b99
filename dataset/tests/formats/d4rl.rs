//! The rules that turn rows of D4RL's layout into transitions, against NumPy.

use std::path::Path;

use ndarray::Array2;
use quad_dataset::{
    Batch, BatchSampler, EnvironmentSpec, ReadOptions, RewardRule, Scale, Transitions, environment,
    recorded_environment,
};
use tempfile::tempdir;

use crate::{all, compare, hopper, peers, read, shared};

/// Compares a file with what `peers.py reference` finds in it.
fn compare_with_rules(path: &Path, environment: Option<&'static EnvironmentSpec>) {
    let folder = tempdir().unwrap();
    let out = folder.path().join("reference.hdf5");
    let limit = environment.map_or(0, |environment| environment.max_episode_steps).to_string();
    let goal = if environment.is_some_and(|environment| environment.goal.is_some()) { "1" } else { "0" };
    if peers(&["reference", path.to_str().unwrap(), &limit, goal, out.to_str().unwrap()]) {
        compare(path, environment, &out);
    }
}

fn compare_generated(variant: &str) {
    let folder = tempdir().unwrap();
    let path = folder.path().join("generated.hdf5");
    if peers(&["generate", variant, path.to_str().unwrap()]) {
        compare_with_rules(&path, Some(hopper()));
        assert_eq!(recorded_environment(&path).unwrap(), None);
    }
}

#[test]
fn terminals_timeouts_and_both() {
    compare_generated("plain");
}

#[test]
fn double_precision_as_in_replay_files() {
    compare_generated("float64");
}

#[test]
fn rewards_and_flags_of_shape_n_by_1() {
    compare_generated("columns");
}

#[test]
fn flags_as_integers() {
    compare_generated("integers");
}

#[test]
fn v0_has_timeouts_from_the_time_limit() {
    compare_generated("v0");
}

#[test]
fn v1_stores_next_observations_that_are_not_used() {
    compare_generated("v1");
}

#[test]
fn rows_that_do_not_follow_one_another_are_refused() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("generated.hdf5");
    if peers(&["generate", "shuffled", path.to_str().unwrap()]) {
        let options = ReadOptions { environment: Some(hopper()), reward: RewardRule::AsIs, scale: Scale::default() };
        let error = Transitions::read(&path, &options).err().unwrap();
        // Of 600 rows two end an episode, and after the last one there is nothing to compare it with.
        let expected = "array `next_observations`, row 0: not the observation of the row that follows, though the episode \
                        continues there (597 such rows)";
        assert!(error.to_string().ends_with(expected), "{error}");
        assert!(error.hint().contains("`layout`") && error.hint().contains("timeouts"), "{}", error.hint());
    }
}

#[test]
fn an_unknown_environment_has_the_files_sizes_and_timeouts() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("generated.hdf5");
    if peers(&["generate", "plain", path.to_str().unwrap()]) {
        compare_with_rules(&path, None);
    }
}

#[test]
fn antmaze_goes_on_after_the_goal() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("antmaze.hdf5");
    if peers(&["generate-antmaze", path.to_str().unwrap()]) {
        let umaze = environment::find("antmaze-umaze").unwrap();
        compare_with_rules(&path, Some(umaze));
        let transitions = read(&path, Some(umaze), RewardRule::Subtract1);
        let statistics = transitions.statistics();
        assert_eq!((statistics.episodes, statistics.transitions), (5, 2900 - 1 - 4));
        assert_eq!(statistics.score_mean, Some(80.0), "four of five episodes reach the goal");
        let scaled = all(&transitions).rewards;
        assert_eq!((scaled[199], scaled[200]), (-1.0, 0.0));
    }
}

#[test]
fn recorded_files() {
    for (name, environment) in [
        ("data/hopper_medium_replay.hdf5", "hopper"),
        ("data/halfcheetah_medium_replay.hdf5", "halfcheetah"),
        ("data/walker2d_medium_replay.hdf5", "walker2d"),
        ("data/antmaze_umaze.hdf5", "antmaze-umaze"),
        ("data/antmaze_medium_play.hdf5", "antmaze-medium"),
        ("fixtures/hopper_fixture-v2.hdf5", "hopper"),
    ] {
        if let Some(path) = shared(name) {
            compare_with_rules(&path, Some(environment::find(environment).unwrap()));
        }
    }
}

#[test]
fn a_sampler_fills_batches_with_each_transition_once_a_pass() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("rows.hdf5");
    let file = hdf5::File::create(&path).unwrap();
    let rows: usize = 8;
    let write = |name: &str, width: usize, value: &dyn Fn(usize) -> f32| {
        let data = Array2::from_shape_fn((rows, width), |(i, _)| value(i));
        file.new_dataset_builder().with_data(&data).create(name).unwrap();
    };
    write("observations", 11, &|i| i as f32);
    write("actions", 3, &|i| i as f32 / 3.5 - 1.0);
    write("rewards", 1, &|i| i as f32);
    file.new_dataset_builder()
        .with_data(&[false, false, true, false, false, false, false, false])
        .create("terminals")
        .unwrap();
    drop(file);

    let transitions = read(&path, Some(hopper()), RewardRule::AsIs);
    assert_eq!((transitions.len(), transitions.observation_dim(), transitions.action_dim()), (7, 11, 3));
    let mut sampler = BatchSampler::new(transitions.len(), 3, 5, 0);
    let mut batch = Batch::default();
    let mut drawn = Vec::new();
    for _ in 0..7 {
        transitions.gather(sampler.next_items(), &mut batch);
        assert_eq!(batch.size, 3);
        for k in 0..3 {
            let i = batch.observations[11 * k] as usize;
            assert_eq!(batch.observations[11 * k..11 * (k + 1)], [i as f32; 11]);
            assert_eq!(batch.next_observations[11 * k..11 * (k + 1)], [i as f32 + 1.0; 11]);
            assert_eq!(batch.actions[3 * k..3 * (k + 1)], [(i as f32 / 3.5 - 1.0).clamp(-0.99999, 0.99999); 3]);
            assert_eq!(batch.rewards[k], i as f32);
            assert_eq!(batch.masks[k], if i == 2 { 0.0 } else { 1.0 });
            drawn.push(i);
        }
    }
    for pass in drawn.chunks(7) {
        let mut pass = pass.to_vec();
        pass.sort_unstable();
        assert_eq!(pass, [0, 1, 2, 3, 4, 5, 6]);
    }
}
