use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use quad_dataset::{
    DatasetError, Normalize, ReadOptions, RewardRule, Transitions, benchmarks, environment,
};
use tempfile::{TempDir, tempdir};

use crate::{all, compare, hopper, peers, try_read};

fn written(variant: &str) -> Option<(TempDir, PathBuf)> {
    let folder = tempdir().unwrap();
    let path = folder.path().join("made-up-singletask-v0.npz");
    peers(&["write-ogbench", variant, path.to_str().unwrap()]).then_some((folder, path))
}

fn error(path: &Path) -> DatasetError {
    try_read(path, Some(hopper())).err().unwrap()
}

#[test]
fn whatever_way_it_is_stored() {
    let Some((folder, path)) = written("raw") else { return };
    let out = folder.path().join("reference.hdf5");
    assert!(peers(&["ogbench-reference", path.to_str().unwrap(), out.to_str().unwrap()]));
    compare(&path, Some(hopper()), &out);
    for variant in ["fortran", "regular", "compact"] {
        let (_folder, path) = written(variant).unwrap();
        compare(&path, Some(hopper()), &out);
    }
}

#[test]
fn without_rewards_there_is_nothing_to_learn() {
    let Some((_folder, path)) = written("goals") else { return };
    let error = error(&path);
    assert!(error.to_string().ends_with("array `rewards` is missing"), "{error}");
    assert!(error.hint().contains("quad-convert ogbench:NAME"), "{}", error.hint());
}

#[test]
fn a_task_in_a_maze_has_ogbenchs_start_rewards_and_masks() {
    let folder = tempdir().unwrap();
    if !peers(&["ogbench-mazes", folder.path().to_str().unwrap()]) {
        return;
    }
    let environments: BTreeSet<String> = benchmarks::tasks()
        .filter(|task| task.maze.is_some())
        .map(|task| task.environment)
        .collect();
    assert_eq!(environments.len(), 11 * 6);
    for name in environments {
        let place = name.split("-singletask").next().unwrap();
        let file = hdf5::File::open(folder.path().join(format!("{name}.hdf5"))).unwrap();
        let array = |array: &str| file.dataset(array).unwrap().read_raw::<f32>().unwrap();
        let task = benchmarks::relabeling(&name);
        assert_eq!(task.unwrap().start.map(|x| x as f32).to_vec(), array("start"), "{name}");
        let environment = environment::find(&name).ok();
        let options = ReadOptions {
            environment,
            task,
            reward: RewardRule::Subtract1,
            normalize: Normalize::default(),
        };
        let transitions =
            Transitions::read(folder.path().join(format!("{place}.npz")), &options).unwrap();
        let batch = all(&transitions);
        assert_eq!((batch.rewards, &batch.masks), (array("rewards"), &array("masks")), "{name}");
        assert!(
            (10..150).contains(&batch.masks.iter().filter(|mask| **mask == 0.0).count()),
            "{name}"
        );
        // One trajectory in six is around one of five goals, with return 1.
        assert!((0.1..0.7).contains(&transitions.statistics().return_mean), "{name}");
    }
}

#[test]
fn a_maze_of_ogbench_is_learned_from_but_not_scored_in_one_of_ours() {
    let Some((_folder, path)) = written("maze") else { return };
    assert!(try_read(&path, None).is_ok());
    let error = try_read(&path, environment::find("antmaze-medium").ok()).err().unwrap();
    assert!(
        error.to_string().ends_with("recorded in `OGBench`, which is not `antmaze-medium`"),
        "{error}"
    );
    assert!(
        error.hint().contains("antmaze-large-navigate-singletask-task1-v0"),
        "{}",
        error.hint()
    );
}

#[test]
fn discrete_actions() {
    let Some((_folder, path)) = written("discrete") else { return };
    let error = error(&path).to_string();
    assert!(
        error.contains("array `actions` holds whole numbers, as if actions were discrete"),
        "{error}"
    );
}

#[test]
fn cut_short_and_damaged_inside() {
    let Some((_folder, path)) = written("raw") else { return };
    let whole = std::fs::read(&path).unwrap();
    for length in [4, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&path, &whole[..length]).unwrap();
        assert!(
            error(&path).to_string().ends_with("a damaged or incomplete npz archive"),
            "{length} bytes"
        );
    }
    let mut damaged = whole;
    damaged[300..340].fill(7);
    std::fs::write(&path, damaged).unwrap();
    assert!(
        error(&path).to_string().ends_with("array `observations` cannot be read"),
        "{}",
        error(&path)
    );
}
