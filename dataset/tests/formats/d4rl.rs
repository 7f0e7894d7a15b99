use std::path::Path;

use quad_dataset::{RewardRule, environment, recorded_environment};

use crate::{
    Environment, all, assert_refused, compare, hopper, peers, put, read, scratch, shared, steps,
    try_read, write, written,
};

/// Compares a file with the output of `peers.py reference`.
fn compare_with_rules(path: &Path, environment: Environment) {
    let (_folder, out) = scratch("reference.hdf5");
    let limit = environment.map_or(0, |spec| spec.max_episode_steps).to_string();
    let is_maze = environment.is_some_and(|spec| spec.maze.is_some());
    let [from, to] = [path, &out].map(|path| path.to_str().unwrap());
    if peers(&["reference", from, &limit, if is_maze { "1" } else { "0" }, to]) {
        compare(path, environment, &out);
    }
}

#[test]
fn every_version_follows_the_rules() {
    for variant in ["plain", "float64", "columns", "integers", "v0", "v1"] {
        let Some((_folder, path)) = written("generate", variant, "d4rl.hdf5") else { return };
        compare_with_rules(&path, Some(hopper()));
        assert_eq!(recorded_environment(&path).unwrap(), None);
        if variant == "plain" {
            compare_with_rules(&path, None);
        }
    }
}

#[test]
fn rows_that_do_not_follow_one_another_are_refused() {
    let Some((_folder, path)) = written("generate", "shuffled", "d4rl.hdf5") else { return };
    // The last row and two ends of episodes are not compared.
    let message = "array `next_observations`, row 0: not the observation of the next row, though the episode goes on \
                   (597 such rows)";
    assert_refused(
        &path,
        Some(hopper()),
        message,
        "where episodes end in `terminals` and `timeouts`",
    );
    assert_refused(&path, Some(hopper()), message, "the attribute `layout`");
}

#[test]
fn antmaze_goes_on_after_the_goal() {
    let (_folder, path) = scratch("antmaze.hdf5");
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
fn a_recording_with_a_goal_goes_on_after_it_in_whatever_environment() {
    let (_folder, path) = scratch("goal.hdf5");
    let mut arrays = steps(8, 2, 1);
    arrays.rewards.fill(0.0);
    for row in [2, 3, 6] {
        (arrays.rewards[row], arrays.terminals[row]) = (1.0, true);
    }
    (arrays.timeouts[4], arrays.timeouts[7]) = (true, true);
    let file = write(&path, &arrays);
    file.flush().unwrap();
    assert_eq!(try_read(&path, None).unwrap().statistics().episodes, 5);
    file.create_group("infos").unwrap();
    put(&file, "infos/goal", &[8, 2], &[0.0f32; 16]);
    drop(file);
    let transitions = try_read(&path, None).unwrap();
    // Returns exclude rewards after the goal.
    assert_eq!((transitions.statistics().episodes, transitions.statistics().return_max), (2, 1.0));
}

#[test]
fn a_goal_without_terminals_does_not_end_returns() {
    let (_folder, path) = scratch("maze2d.hdf5");
    let mut arrays = steps(8, 2, 1);
    (arrays.timeouts[3], arrays.timeouts[7]) = (true, true);
    let file = write(&path, &arrays);
    file.create_group("infos").unwrap();
    put(&file, "infos/goal", &[8, 2], &[0.0f32; 16]);
    drop(file);
    assert_eq!(try_read(&path, None).unwrap().statistics().return_mean, 4.0);
}
