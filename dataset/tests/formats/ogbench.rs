use std::collections::BTreeSet;

use quad_dataset::{RewardRule, Transitions, benchmarks, environment};
use tempfile::{TempDir, tempdir};

use crate::{assert_refused, batch, compare, hopper, options, peers, try_read, written};

fn archive(variant: &str) -> Option<(TempDir, std::path::PathBuf)> {
    written("write-ogbench", variant, "made-up-singletask-v0.npz")
}

#[test]
fn whatever_way_it_is_stored() {
    let file = archive("raw");
    let Some((folder, path)) = file else { return };
    let out = folder.path().join("reference.hdf5");
    let [from, to] = [&path, &out].map(|path| path.to_str().unwrap());
    assert!(peers(&["ogbench-reference", from, to]));
    compare(&path, Some(hopper()), &out);
    for variant in ["fortran", "regular", "compact"] {
        let (_folder, path) = archive(variant).unwrap();
        compare(&path, Some(hopper()), &out);
    }
}

#[test]
fn a_task_in_a_maze_has_ogbenchs_start_rewards_and_masks() {
    let folder = tempdir().unwrap();
    if !peers(&["ogbench-mazes", folder.path().to_str().unwrap()]) {
        return;
    }
    let tasks = benchmarks::tasks().filter(|task| task.maze.is_some());
    let environments = BTreeSet::from_iter(tasks.map(|task| task.environment));
    assert_eq!(environments.len(), 11 * 6);
    for name in environments {
        let place = name.split("-singletask").next().unwrap();
        let file = hdf5::File::open(folder.path().join(format!("{name}.hdf5"))).unwrap();
        let array = |array: &str| file.dataset(array).unwrap().read_raw::<f32>().unwrap();
        let task = benchmarks::relabeling(&name);
        let start = task.unwrap().start.map(|x| x as f32);
        assert_eq!(array("start"), start, "{name}");
        let mut options = options(environment::find(&name).ok(), RewardRule::Subtract1);
        options.task = task;
        let path = folder.path().join(format!("{place}.npz"));
        let transitions = Transitions::read(path, &options).unwrap();
        let batch = batch(&transitions);
        assert_eq!(batch.rewards, array("rewards"), "{name}");
        assert_eq!(batch.masks, array("masks"), "{name}");
        let reached = batch.masks.iter().filter(|mask| **mask == 0.0).count();
        assert!((10..150).contains(&reached), "{name}: {reached}");
        // One trajectory in six is around one of five goals, with return 1.
        let mean = transitions.statistics().return_mean;
        assert!((0.1..0.7).contains(&mean), "{name}: {mean}");
    }
}

#[test]
fn files_that_are_refused() {
    let goals = "array `rewards` is missing";
    let discrete =
        "array `actions` holds whole numbers, but only continuous actions can be learned";
    let maze = "recorded in `OGBench`, which is not `antmaze-medium`";
    for (variant, name, message, hint) in [
        ("goals", "hopper", goals, "quad-convert ogbench:NAME"),
        ("maze", "antmaze-medium", maze, "antmaze-large-navigate"),
        ("discrete", "hopper", discrete, "float32"),
    ] {
        let file = archive(variant);
        let Some((_folder, path)) = file else { return };
        assert_refused(&path, environment::find(name).ok(), message, hint);
        assert_eq!(try_read(&path, None).is_ok(), variant == "maze");
    }
}

#[test]
fn cut_short_and_damaged_inside() {
    let file = archive("raw");
    let Some((_folder, path)) = file else { return };
    let mut whole = std::fs::read(&path).unwrap();
    for length in [4, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&path, &whole[..length]).unwrap();
        let message = "a damaged or incomplete npz archive";
        assert_refused(&path, Some(hopper()), message, "again");
    }
    whole[300..340].fill(7);
    std::fs::write(&path, whole).unwrap();
    let message = "array `observations` cannot be read";
    assert_refused(&path, Some(hopper()), message, "damaged");
}
