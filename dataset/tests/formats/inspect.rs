use std::path::Path;

use ndarray::{Array1, Array2};
use quad_dataset::{RewardRule, environment, inspect};
use tempfile::tempdir;

use crate::{generated, hopper, peers, read, shared};

fn write_robot(path: &Path, spoil: impl Fn(&mut Array2<f32>, &mut Array2<f32>, &mut Array1<f32>)) {
    let mut observations = Array2::from_shape_fn((10, 3), |(i, j)| (i + j) as f32);
    let mut actions =
        Array2::from_shape_fn((10, 2), |(i, j)| if j == 0 { 0.5 } else { -0.1 * i as f32 });
    let mut rewards = Array1::from_shape_fn(10, |i| i as f32);
    spoil(&mut observations, &mut actions, &mut rewards);
    let file = hdf5::File::create(path).unwrap();
    let flags = |row: usize| Array1::from_shape_fn(10, |i| i == row);
    file.new_dataset_builder().with_data(&observations).create("observations").unwrap();
    file.new_dataset_builder().with_data(&actions).create("actions").unwrap();
    file.new_dataset_builder().with_data(&rewards).create("rewards").unwrap();
    file.new_dataset_builder().with_data(&flags(3)).create("terminals").unwrap();
    file.new_dataset_builder().with_data(&flags(7)).create("timeouts").unwrap();
}

#[test]
fn figures_of_a_file_that_can_be_followed_by_eye() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("robot.hdf5");
    write_robot(&path, |_, _, _| ());
    let json = serde_json::to_value(inspect(&path, None).unwrap()).unwrap();
    for (field, expected) in [
        ("transitions", 8.0), // the timeout and the last row make none
        ("episodes", 3.0),
        ("min_length", 2.0),
        ("mean_length", 10.0 / 3.0),
        ("max_length", 4.0),
        ("min_return", 6.0),
        ("mean_return", 15.0),
        ("max_return", 22.0),
        ("terminals", 0.1),
        ("timeouts", 0.1),
    ] {
        assert_eq!(json[field].as_f64(), Some(expected), "{field} in {json}");
    }
    assert_eq!(json["action_ranges"][0], serde_json::json!({"min": 0.5, "max": 0.5}));
    assert_eq!(json["observation_range"], serde_json::json!({"min": 0.0, "max": 11.0}));
    assert_eq!(json["problems"], serde_json::json!([]));
    assert!(json.get("mean_score").is_none(), "no reference returns are known");
}

#[test]
fn figures_are_those_of_training() {
    let Some((_folder, path)) = generated("plain") else { return };
    let inspection = inspect(&path, Some(hopper())).unwrap();
    let statistics = *read(&path, Some(hopper()), RewardRule::AsIs).statistics();
    assert_eq!(
        (inspection.transitions, inspection.episodes),
        (statistics.transitions, statistics.episodes)
    );
    let ours = [inspection.min_return, inspection.mean_return, inspection.max_return];
    assert_eq!(ours, [statistics.return_min, statistics.return_mean, statistics.return_max]);
    assert_eq!(inspection.scores.as_ref().map(|scores| scores.mean_score), statistics.score_mean);
    assert_eq!(
        (inspection.refused, inspection.problems.len()),
        (false, 0),
        "{:?}",
        inspection.problems
    );
    let text = inspection.to_string();
    for words in
        ["transitions   21\n", "returns of the episodes\n", "no problems found", "score  ", "####"]
    {
        assert!(text.contains(words), "{words} is not in\n{text}");
    }
}

#[test]
fn everything_that_is_wrong_is_named_at_once() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("robot.hdf5");
    write_robot(&path, |observations, actions, rewards| {
        observations[[5, 1]] = f32::NAN;
        observations[[6, 0]] = f32::INFINITY;
        actions[[2, 0]] = 7.5;
        rewards[8] = f32::NAN;
    });
    let inspection = inspect(&path, Some(hopper())).unwrap();
    assert_eq!(
        inspection.problems,
        [
            "`observations` has 3 numbers a row, but `hopper` has 11",
            "`actions` has 2 numbers a row, but `hopper` has 3",
            "array `observations`, row 5: NaN is not a finite float32 (2 such rows)",
            "array `rewards`, row 8: NaN is not a finite float32",
            "array `actions`, row 2: the action 7.5 is outside [-1, 1]; `learner train --normalize actions` trains on it",
        ]
    );
    assert!(inspection.refused && inspection.to_string().contains("training refuses this dataset"));
    assert_eq!(
        (inspection.mean_return, inspection.max_return),
        (14.0, 22.0),
        "the third episode has no return"
    );
    assert_eq!(inspection.observation_range.max, 11.0);
}

#[test]
fn an_empty_file_is_described_too() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("empty.hdf5");
    let file = hdf5::File::create(&path).unwrap();
    for (name, width) in [("observations", 3), ("actions", 2), ("rewards", 1), ("terminals", 1)] {
        file.new_dataset_builder()
            .with_data(&Array2::<f32>::zeros((0, width)))
            .create(name)
            .unwrap();
    }
    drop(file);
    let inspection = inspect(&path, None).unwrap();
    assert_eq!((inspection.transitions, inspection.episodes, inspection.refused), (0, 0, true));
    assert_eq!(inspection.problems[0], "0 rows, of which none makes a transition");
    assert!(serde_json::to_value(&inspection).unwrap()["mean_return"].is_null());
    assert!(inspection.to_string().contains("0 rows"));
}

#[test]
fn missing_timeouts_and_stored_observations_that_do_not_follow() {
    let Some((_folder, path)) = generated("v0") else { return };
    let problems = inspect(&path, Some(hopper())).unwrap().problems;
    assert_eq!(
        problems,
        ["no array `timeouts`: an episode is taken to end after the 1000 steps of hopper"]
    );
    let Some((_folder, path)) = generated("v1") else { return };
    let problems = inspect(&path, Some(hopper())).unwrap().problems;
    let expected = "array `next_observations`, row 100: not the observation of the row that follows, though the episode \
                    continues there; is a timeout missing?";
    assert_eq!(problems, [expected]);
}

#[test]
fn a_maze_that_is_left_by_a_leap() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("antmaze.hdf5");
    let umaze = environment::find("antmaze-umaze").unwrap();
    if !peers(&["generate-antmaze", path.to_str().unwrap()]) {
        return;
    }
    // Positions are noise, so the ant leaps at each step.
    let inspection = inspect(&path, Some(umaze)).unwrap();
    assert_eq!(inspection.scores.unwrap().mean_score, 80.0);
    let [problem] = &inspection.problems[..] else { panic!("{:?}", inspection.problems) };
    assert!(problem.contains("more than 1 m away") && problem.contains("out of step"), "{problem}");
}

#[test]
fn recorded_files_are_without_problems() {
    for (name, environment, transitions, episodes) in [
        ("hopper_medium_replay", "hopper", 101_028 - 1 - 8, 897),
        ("halfcheetah_medium_replay", "halfcheetah", 100_000 - 100, 100),
        ("antmaze_umaze", "antmaze-umaze", 70_000 - 100, 100),
        ("antmaze_medium_play", "antmaze-medium", 100_000 - 100, 100),
    ] {
        let Some(path) = shared(&format!("data/{name}.hdf5")) else { continue };
        let inspection = inspect(&path, Some(environment::find(environment).unwrap())).unwrap();
        assert_eq!(inspection.problems, [""; 0], "{name}");
        assert_eq!(
            (inspection.transitions, inspection.episodes),
            (transitions, episodes),
            "{name}"
        );
    }
}
