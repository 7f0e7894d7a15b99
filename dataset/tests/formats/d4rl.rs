use std::path::Path;

use quad_dataset::{Arrays, RewardRule, environment, recorded_environment};

use crate::{
    Environment, assert_refused, batch, compare, hopper, peers, put, read, scratch, steps,
    try_read, write, written,
};

/// Compares a file with the output of `peers.py reference`.
fn compare_with_rules(path: &Path, environment: Environment) {
    let (_folder, out) = scratch("reference.hdf5");
    let limit = environment.map_or(0, |spec| spec.max_episode_steps);
    let is_maze = environment.is_some_and(|spec| spec.maze.is_some());
    let [limit, is_maze] = [limit, usize::from(is_maze)].map(|number| number.to_string());
    let [from, to] = [path, &out].map(|path| path.to_str().unwrap());
    if peers(&["reference", from, &limit, &is_maze, to]) {
        compare(path, environment, &out);
    }
}

#[test]
fn every_version_follows_the_rules() {
    for variant in ["plain", "float64", "columns", "integers", "v0", "v1"] {
        let file = written("generate", variant, "d4rl.hdf5");
        let Some((_folder, path)) = file else { return };
        compare_with_rules(&path, Some(hopper()));
        assert_eq!(recorded_environment(&path).unwrap(), None);
        if variant == "plain" {
            compare_with_rules(&path, None);
        }
    }
}

#[test]
fn rows_that_do_not_follow_one_another_are_refused() {
    let file = written("generate", "shuffled", "d4rl.hdf5");
    let Some((_folder, path)) = file else { return };
    // The last row and two ends of episodes are not compared.
    let message = "array `next_observations`, row 0: not the observation of the next row, though the episode goes on \
                   (597 such rows)";
    let hint = "where episodes end in `terminals` and `timeouts`; for rows in any other order set the attribute `layout`";
    assert_refused(&path, Some(hopper()), message, hint);
}

#[test]
fn antmaze_goes_on_after_the_goal() {
    let (_folder, path) = scratch("antmaze.hdf5");
    if peers(&["generate-antmaze", path.to_str().unwrap()]) {
        let umaze = environment::find("antmaze-umaze").unwrap();
        compare_with_rules(&path, Some(umaze));
        let transitions = read(&path, Some(umaze), RewardRule::Subtract1);
        let statistics = transitions.statistics();
        assert_eq!(statistics.episodes, 5);
        assert_eq!(statistics.transitions, 2900 - 1 - 4);
        // Four of five episodes reach the goal.
        assert_eq!(statistics.score_mean, Some(80.0));
        let scaled = batch(&transitions).rewards;
        assert_eq!((scaled[199], scaled[200]), (-1.0, 0.0));
    }
}

#[test]
fn a_recording_with_a_goal_goes_on_after_it_in_whatever_environment() {
    let (_folder, path) = scratch("goal.hdf5");
    let mut arrays = steps(8, 2, 1);
    (arrays.timeouts[4], arrays.timeouts[7]) = (true, true);
    let read = |arrays: &Arrays, has_goal: bool| {
        let file = write(&path, arrays);
        if has_goal {
            file.create_group("infos").unwrap();
            put(&file, "infos/goal", &[8, 2], &[0.0f32; 16]);
        }
        drop(file);
        *try_read(&path, None).unwrap().statistics()
    };
    // Without terminals, as in mazes with dense rewards, a goal ends nothing.
    assert_eq!(read(&arrays, true).return_max, 5.0);
    arrays.rewards.fill(0.0);
    for row in [2, 3, 6] {
        (arrays.rewards[row], arrays.terminals[row]) = (1.0, true);
    }
    assert_eq!(read(&arrays, false).episodes, 5);
    let statistics = read(&arrays, true);
    // Returns exclude rewards after the goal.
    assert_eq!((statistics.episodes, statistics.return_max), (2, 1.0));
}
