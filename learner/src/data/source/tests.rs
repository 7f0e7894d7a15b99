//! Tests of the values of `--dataset`.

use quad_run::config::{resolve, tasks};

use super::*;

#[test]
fn names_paths_and_unknown_names() {
    let named = Source::parse("walker2d-medium-replay-v2").unwrap();
    assert_eq!(named.entry().unwrap().file, "walker2d_medium_replay-v2.hdf5");
    assert_eq!(Source::parse("minari:a/b-v0").unwrap(), Source::Minari("a/b-v0".to_owned()));
    for path in ["data/missing.hdf5", "missing.npz", "./hopper-medium-v2", "/tmp"] {
        assert_eq!(Source::parse(path).unwrap(), Source::Path(path.into()));
    }
    let error = Source::parse("quadruped").unwrap_err().to_string();
    assert_eq!(error, "unknown dataset `quadruped`");
}

#[test]
fn the_datasets_of_all_tasks_are_known_and_fit() {
    let resolved =
        tasks::all().iter().map(|task| resolve(&task.name, &toml::Table::new()).unwrap());
    let named: Vec<_> = resolved.filter(|experiment| experiment.dataset.is_some()).collect();
    assert_eq!(
        named.len(),
        15 + 6 + 24 * 6,
        "the rows of the paper's table, version 2's mazes, OGBench's"
    );
    for experiment in named {
        let source = Source::parse(&experiment.dataset.unwrap()).unwrap();
        assert!(matches!(source, Source::Named(_)), "{source:?}");
        source.check_environment(&experiment.environment).unwrap();
    }
}

#[test]
fn data_of_another_simulation_is_refused() {
    for (source, environment, fits) in [
        ("hopper-medium-v2", "hopper", true),
        ("hopper-medium-v2", "walker2d", false),
        ("hopper-medium-v2", "my-robot", false),
        // The goal of v0 and v2 is another one, not the maze.
        ("antmaze-umaze-v2", "antmaze-umaze-v0", true),
        ("antmaze-medium-play-v0", "antmaze-umaze", false),
        ("antmaze-giant-stitch-v0", "antmaze-giant-singletask-task3-v0", true),
        ("antmaze-giant-stitch-v0", "antmaze-large-singletask-task3-v0", false),
        ("antmaze-medium-stitch-v0", "antmaze-medium", false),
        ("antmaze-medium-play-v2", "antmaze-medium-singletask-v0", false),
        ("humanoidmaze-large-stitch-v0", "humanoidmaze-large-singletask-task3-v0", true),
        // The catalog knows the first file by its name.
        ("data/hopper_medium-v2.hdf5", "walker2d", false),
        ("data/mine.hdf5", "walker2d", true),
    ] {
        let checked = Source::parse(source).unwrap().check_environment(environment);
        assert_eq!(checked.is_ok(), fits, "{source} for {environment}: {checked:?}");
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
