use std::path::Path;

use quad_dataset::{EnvironmentSpec, RewardRule, environment, recorded_environment};
use tempfile::tempdir;

use crate::{all, compare, generated, hopper, peers, put, read, shared, try_read};

/// Compares a file with the output of `peers.py reference`.
fn compare_with_rules(path: &Path, environment: Option<&'static EnvironmentSpec>) {
    let folder = tempdir().unwrap();
    let out = folder.path().join("reference.hdf5");
    let limit = environment.map_or(0, |environment| environment.max_episode_steps).to_string();
    let goal =
        if environment.is_some_and(|environment| environment.maze.is_some()) { "1" } else { "0" };
    if peers(&["reference", path.to_str().unwrap(), &limit, goal, out.to_str().unwrap()]) {
        compare(path, environment, &out);
    }
}

#[test]
fn every_version_follows_the_rules() {
    for variant in ["plain", "float64", "columns", "integers", "v0", "v1"] {
        let Some((_folder, path)) = generated(variant) else { return };
        compare_with_rules(&path, Some(hopper()));
        assert_eq!(recorded_environment(&path).unwrap(), None);
    }
    let Some((_folder, path)) = generated("plain") else { return };
    compare_with_rules(&path, None);
}

#[test]
fn rows_that_do_not_follow_one_another_are_refused() {
    let Some((_folder, path)) = generated("shuffled") else { return };
    let error = try_read(&path, Some(hopper())).err().unwrap();
    // The last row and two ends of episodes are not compared.
    let expected = "array `next_observations`, row 0: not the observation of the row that follows, though the episode \
                    continues there (597 such rows)";
    assert!(error.to_string().ends_with(expected), "{error}");
    assert!(
        error.hint().contains("`layout`") && error.hint().contains("timeouts"),
        "{}",
        error.hint()
    );
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
fn a_recording_with_a_goal_goes_on_after_it_in_whatever_environment() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("goal.hdf5");
    let file = hdf5::File::create(&path).unwrap();
    let flags = |rows: &[usize]| std::array::from_fn::<_, 8, _>(|row| rows.contains(&row));
    put(&file, "observations", &[8, 2], &std::array::from_fn::<f32, 16, _>(|i| i as f32));
    put(&file, "actions", &[8, 1], &[0.5f32; 8]);
    put(&file, "rewards", &[8], &flags(&[2, 3, 6]).map(f32::from));
    put(&file, "terminals", &[8], &flags(&[2, 3, 6]));
    put(&file, "timeouts", &[8], &flags(&[4, 7]));
    assert_eq!(try_read(&path, None).unwrap().statistics().episodes, 5);
    file.create_group("infos").unwrap();
    put(&file, "infos/goal", &[8, 2], &[0.0f32; 16]);
    drop(file);
    let transitions = try_read(&path, None).unwrap();
    // Returns exclude rewards after the goal.
    assert_eq!((transitions.statistics().episodes, transitions.statistics().return_max), (2, 1.0));
}
