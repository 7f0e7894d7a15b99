use quad_dataset::{Arrays, Inspection, RewardRule, environment, inspect};
use serde_json::json;

use crate::{hopper, peers, read, scratch, steps, warnings, write, written};

fn robot() -> Arrays {
    let mut robot = steps(10, 3, 2);
    robot.observations = (0..30).map(|i| (i / 3 + i % 3) as f32).collect();
    robot.actions = (0..10).flat_map(|i| [0.5, -0.1 * i as f32]).collect();
    robot.rewards = (0..10).map(|i| i as f32).collect();
    (robot.terminals[3], robot.timeouts[7]) = (true, true);
    robot
}

#[test]
fn figures_of_a_file_that_can_be_followed_by_eye() {
    let (_folder, path) = scratch("robot.hdf5");
    write(&path, &robot());
    let inspection = serde_json::to_value(inspect(&[&path], None).unwrap()).unwrap();
    let expected = json!({
        "transitions": 8, // the timeout and the last row make none
        "episodes": 3, "min_length": 2.0, "mean_length": 10.0 / 3.0, "max_length": 4.0,
        "min_return": 6.0, "mean_return": 15.0, "max_return": 22.0,
        "terminals": 0.1, "timeouts": 0.1, "problems": [],
        "observation_range": {"min": 0.0, "max": 11.0},
    });
    for (field, expected) in expected.as_object().unwrap() {
        assert_eq!(inspection[field], *expected, "{field}");
    }
    let range = json!({"min": 0.5, "max": 0.5});
    assert_eq!(inspection["action_ranges"][0], range);
    let score = inspection.get("mean_score");
    assert_eq!(score, None, "no reference returns are known");
}

#[test]
fn figures_are_those_of_training() {
    let file = written("generate", "plain", "d4rl.hdf5");
    let Some((_folder, path)) = file else { return };
    let inspection = inspect(&[&path], Some(hopper())).unwrap();
    let text = inspection.to_string();
    let inspection = serde_json::to_value(inspection).unwrap();
    let statistics = *read(&path, Some(hopper()), RewardRule::AsIs).statistics();
    let (min, mean) = (statistics.return_min, statistics.return_mean);
    let expected = json!({
        "transitions": statistics.transitions, "episodes": statistics.episodes,
        "min_return": min, "mean_return": mean, "max_return": statistics.return_max,
        "min_score": hopper().normalized_score(min), "mean_score": statistics.score_mean,
        "problems": [], "refused": false,
    });
    for (field, expected) in expected.as_object().unwrap() {
        assert_eq!(inspection[field], *expected, "{field}");
    }
    for words in ["transitions   21\n", "score  ", "####", "no problems found"] {
        assert!(text.contains(words), "{words} is not in\n{text}");
    }
}

#[test]
fn everything_that_is_wrong_is_named_at_once() {
    let (_folder, path) = scratch("robot.hdf5");
    let mut robot = robot();
    (robot.observations[16], robot.observations[18]) = (f32::NAN, f32::INFINITY);
    (robot.actions[4], robot.rewards[8]) = (7.5, f32::NAN);
    write(&path, &robot);
    let inspection = inspect(&[&path], Some(hopper())).unwrap();
    let expected = [
        "`observations` has 3 numbers a row, but `hopper` has 11; choose a dataset of that environment",
        "`actions` has 2 numbers a row, but `hopper` has 3; choose",
        "array `observations`, row 5: NaN is not a finite float32 (2 such rows); leave out or repair",
        "array `rewards`, row 8: NaN is not a finite float32; leave",
        "array `actions`, row 2: the action 7.5 is outside [-1, 1]; `learner train --normalize actions` trains on them",
    ];
    assert_eq!(inspection.problems.len(), expected.len());
    for (problem, start) in inspection.problems.iter().zip(expected) {
        assert!(problem.starts_with(start), "{problem}, not {start}");
    }
    let page = inspection.to_string();
    assert!(inspection.refused && page.contains("training refuses this dataset"));
    let returns = (inspection.mean_return, inspection.max_return);
    assert_eq!(returns, (14.0, 22.0), "the third episode has no return");
    assert_eq!(inspection.observation_range.max, 11.0);
}

#[test]
fn an_empty_file_is_described_too() {
    let (_folder, path) = scratch("empty.hdf5");
    write(&path, &steps(0, 3, 2));
    let inspection = inspect(&[&path], None).unwrap();
    assert!(inspection.to_string().contains("0 rows"));
    let start = "0 rows, of which none makes a transition; record more";
    warnings::assert_one(&inspection.problems, start, "");
    let inspection = serde_json::to_value(&inspection).unwrap();
    assert_eq!(inspection["mean_return"], json!(null));
}

/// The only problem, which training also warns of.
fn problem(path: &std::path::Path, environment: &str) -> (Inspection, String) {
    let spec = environment::find(environment).unwrap();
    let inspection = inspect(&[path], Some(spec)).unwrap();
    let transitions = read(path, Some(spec), spec.reward);
    assert_eq!(warnings::without_name(transitions.warnings(), path), inspection.problems);
    let problem = inspection.problems.concat();
    (inspection, problem)
}

#[test]
fn missing_timeouts_and_observations_that_do_not_follow() {
    let v0 = "no array `timeouts`: an episode is taken to end after the 1000 steps of hopper";
    let v1 = "array `next_observations`, row 100: not the observation of the next row, though the episode goes on; is a timeout missing?";
    for (variant, expected) in [("v0", v0), ("v1", v1)] {
        let file = written("generate", variant, "d4rl.hdf5");
        let Some((_folder, path)) = file else { return };
        assert_eq!(problem(&path, "hopper").1, expected);
    }
    let (_folder, path) = scratch("antmaze.hdf5");
    if peers(&["generate-antmaze", path.to_str().unwrap()]) {
        // Positions are noise, so the ant leaps at each step.
        let (inspection, problem) = problem(&path, "antmaze-umaze");
        assert_eq!(inspection.scores.unwrap().mean_score, 80.0);
        assert!(problem.contains("more than 1 m away"), "{problem}");
    }
}
