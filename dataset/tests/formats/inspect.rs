use quad_dataset::{Arrays, RewardRule, Transitions, environment, inspect};

use crate::{hopper, options, peers, read, scratch, steps, write, written};

fn robot() -> Arrays {
    let row = |row: usize| Vec::from_iter((0..10).map(|i| i == row));
    Arrays {
        observation_dim: 3,
        action_dim: 2,
        observations: (0..30).map(|i| (i / 3 + i % 3) as f32).collect(),
        actions: (0..10).flat_map(|i| [0.5, -0.1 * i as f32]).collect(),
        rewards: (0..10).map(|i| i as f32).collect(),
        next_observations: Vec::new(),
        terminals: row(3),
        timeouts: row(7),
    }
}

#[test]
fn figures_of_a_file_that_can_be_followed_by_eye() {
    let (_folder, path) = scratch("robot.hdf5");
    write(&path, &robot());
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
    let Some((_folder, path)) = written("generate", "plain", "d4rl.hdf5") else { return };
    let inspection = inspect(&path, Some(hopper())).unwrap();
    let statistics = *read(&path, Some(hopper()), RewardRule::AsIs).statistics();
    let ours = (inspection.transitions, inspection.episodes, inspection.refused);
    assert_eq!(ours, (statistics.transitions, statistics.episodes, false));
    let ours = [inspection.min_return, inspection.mean_return, inspection.max_return];
    assert_eq!(ours, [statistics.return_min, statistics.return_mean, statistics.return_max]);
    let expected = ours.map(|episode_return| hopper().normalized_score(episode_return));
    let scores = inspection.scores.as_ref().unwrap();
    assert_eq!([scores.min_score, scores.mean_score, scores.max_score], expected);
    assert_eq!(statistics.score_mean, Some(scores.mean_score));
    assert_eq!(inspection.problems, [""; 0]);
    let text = inspection.to_string();
    let figures = ["transitions   21\n", "score  ", "####"];
    for words in figures.into_iter().chain(["returns of the episodes\n", "no problems found"]) {
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
    let inspection = inspect(&path, Some(hopper())).unwrap();
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
    assert!(inspection.refused && inspection.to_string().contains("training refuses this dataset"));
    let returns = (inspection.mean_return, inspection.max_return);
    assert_eq!(returns, (14.0, 22.0), "the third episode has no return");
    assert_eq!(inspection.observation_range.max, 11.0);
}

#[test]
fn an_empty_file_is_described_too() {
    let (_folder, path) = scratch("empty.hdf5");
    write(&path, &steps(0, 3, 2));
    let inspection = inspect(&path, None).unwrap();
    assert_eq!((inspection.transitions, inspection.episodes, inspection.refused), (0, 0, true));
    let [problem] = &inspection.problems[..] else { panic!("{:?}", inspection.problems) };
    assert!(problem.starts_with("0 rows, of which none makes a transition; record more"));
    assert!(serde_json::to_value(&inspection).unwrap()["mean_return"].is_null());
    assert!(inspection.to_string().contains("0 rows"));
}

#[test]
fn missing_timeouts_and_observations_that_do_not_follow() {
    let v0 = "no array `timeouts`: an episode is taken to end after the 1000 steps of hopper";
    let v1 = "array `next_observations`, row 100: not the observation of the next row, though the episode goes on; is a timeout missing?";
    for (variant, problem) in [("v0", v0), ("v1", v1)] {
        let Some((_folder, path)) = written("generate", variant, "d4rl.hdf5") else { return };
        assert_eq!(inspect(&path, Some(hopper())).unwrap().problems, [problem]);
        let options = options(Some(hopper()), hopper().reward);
        assert_eq!(Transitions::read(&path, &options).unwrap().warnings(), [problem]);
    }
    let (_folder, path) = scratch("antmaze.hdf5");
    let umaze = environment::find("antmaze-umaze").unwrap();
    if !peers(&["generate-antmaze", path.to_str().unwrap()]) {
        return;
    }
    // Positions are noise, so the ant leaps at each step.
    let inspection = inspect(&path, Some(umaze)).unwrap();
    assert_eq!(inspection.scores.unwrap().mean_score, 80.0);
    let [problem] = &inspection.problems[..] else { panic!("{:?}", inspection.problems) };
    let options = options(Some(umaze), umaze.reward);
    assert_eq!(Transitions::read(&path, &options).unwrap().warnings(), inspection.problems);
    assert!(problem.contains("more than 1 m away") && problem.contains("out of step"), "{problem}");
}

#[test]
fn what_ends_an_endless_episode_is_said() {
    let (_folder, path) = scratch("long.hdf5");
    let mut endless = robot();
    endless.terminals.fill(false);
    endless.timeouts.fill(false);
    write(&path, &endless);
    let problems = inspect(&path, None).unwrap().problems;
    let hint = "one endless episode; set `timeouts` to 1 at the last row of each episode";
    assert!(problems[0].contains(hint), "{problems:?}");
}
