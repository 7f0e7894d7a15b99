//! Tests of the values of `--dataset`.

use quad_dataset::{Arrays, Names, write_own};
use quad_run::config::resolve;

use super::*;

#[test]
fn names_and_paths() {
    let named = Source::parse("walker2d-medium-replay-v2").unwrap();
    let file = &named.entry().unwrap().file;
    assert_eq!(file, "walker2d_medium_replay-v2.hdf5");
    let minari = Source::parse("minari:a/b-v0").unwrap();
    assert_eq!(minari, Source::Minari("a/b-v0".to_owned()));
    for path in "data/missing.hdf5 missing.npz ./hopper-medium-v2 /tmp".split(' ') {
        assert_eq!(Source::parse(path).unwrap(), Source::Path(path.into()));
    }
}

#[test]
fn the_datasets_of_all_tasks_are_known_and_fit() {
    let mut count = 0;
    for task in tasks::list() {
        let experiment = resolve(&task.name, &toml::Table::new()).unwrap();
        let Some(dataset) = experiment.dataset.first() else { continue };
        let source = Source::parse(dataset).unwrap();
        assert!(matches!(source, Source::Named(_)), "{source:?}");
        source.check_environment(&experiment.environment).unwrap();
        count += 1;
    }
    // The rows of the paper's table, version 2's mazes, OGBench's.
    assert_eq!(count, 15 + 6 + 24 * 6);
}

/// A dataset and an environment that fits or does not. The goal of mazes v0 and v2 is another one, not
/// the maze. The catalog knows the first file by its name.
const PAIRS: &str = "
fits hopper-medium-v2 hopper
not  hopper-medium-v2 walker2d
not  hopper-medium-v2 my-robot
fits antmaze-umaze-v2 antmaze-umaze-v0
not  antmaze-medium-play-v0 antmaze-umaze
fits antmaze-giant-stitch-v0 antmaze-giant-singletask-task3-v0
not  antmaze-giant-stitch-v0 antmaze-large-singletask-task3-v0
not  antmaze-medium-stitch-v0 antmaze-medium
not  antmaze-medium-play-v2 antmaze-medium-singletask-v0
fits humanoidmaze-large-stitch-v0 humanoidmaze-large-singletask-task3-v0
not  data/hopper_medium-v2.hdf5 walker2d
fits data/mine.hdf5 walker2d";

#[test]
fn data_of_another_simulation_is_refused() {
    for pair in PAIRS.trim().lines() {
        let words = Vec::from_iter(pair.split_whitespace());
        let checked = Source::parse(words[1]).unwrap().check_environment(words[2]);
        assert_eq!(checked.is_ok(), words[0] == "fits", "{pair}: {checked:?}");
    }
}

#[test]
fn data_that_names_no_environment_may_be_another_s() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mine.hdf5");
    let rows = |width: usize| vec![0.5; 4 * width];
    let arrays = Arrays {
        observation_dim: 17,
        action_dim: 6,
        observations: rows(17),
        actions: rows(6),
        rewards: rows(1),
        next_observations: rows(17),
        terminals: vec![true; 4],
        timeouts: vec![false; 4],
    };
    write_own(&path, arrays, Names::default()).unwrap();
    let doubt = |environment| Source::Path(path.clone()).doubt(&path, environment);
    assert!(doubt("walker2d").unwrap().ends_with("but halfcheetah has the same sizes"));
    for only_of_its_sizes in ["hopper", "my-robot"] {
        assert_eq!(doubt(only_of_its_sizes), None);
    }
}

#[test]
fn the_checksum_of_a_folder_is_that_of_its_data() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("main_data.hdf5"), "abc").unwrap();
    let source = Source::Path(folder.path().to_owned());
    // FIPS 180-2, B.1.
    let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
    assert_eq!(source.obtain().unwrap().sha256, abc);
}
