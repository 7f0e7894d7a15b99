use std::fs;
use std::path::{Path, PathBuf};

use quad_dataset::{environment, recorded_environment};
use tempfile::{TempDir, tempdir};

use crate::{
    Environment, assert_refused, batch, compare, hopper, peers_in, put, scratch, try_read,
};

const ID: &str = "made/up-v0";

/// Minari's folder with one dataset, and the dataset's folder.
fn root(kind: &str) -> Option<(TempDir, PathBuf)> {
    let (root, dataset) = scratch(ID);
    peers_in(root.path(), &["write-minari", kind, ID]).then_some((root, dataset))
}

fn compare_with_minari(root: &Path, kind: &str, environment: Environment) {
    let (_folder, out) = scratch("reference.hdf5");
    if peers_in(root, &["minari-reference", kind, ID, out.to_str().unwrap()]) {
        for path in ["", "data", "data/main_data.hdf5"] {
            compare(&root.join(ID).join(path), environment, &out);
        }
    }
}

#[test]
fn arrays_and_a_dict_in_alphabetical_order_and_a_tuple_in_its_own() {
    for (kind, recorded, spec) in [
        ("hopper", "hopper-v5", Some(hopper())),
        ("walker2d", "walker2d-v5", environment::find("walker2d-v5").ok()),
        ("antmaze", "AntMaze_UMaze-v4", None),
        ("own", "Robot-v0", None),
        ("tuple", "Robot-v0", None),
    ] {
        let root = root(kind);
        let Some((root, dataset)) = root else { return };
        let environment = recorded_environment(&dataset).unwrap();
        assert_eq!(environment.as_deref(), Some(recorded));
        compare_with_minari(root.path(), kind, spec);
    }
}

#[test]
fn datasets_that_are_refused() {
    let group = "`episode_0/observations/achieved_goal` is a group of arrays, but must be an array";
    let discrete = "only continuous actions can be learned";
    let maze = "recorded in `AntMaze_UMaze-v4`, which is not `antmaze-umaze`";
    let walker = "recorded in `walker2d-v5`, which is not `walker2d`";
    // Another simulation is learned from, but not scored in ours.
    for (kind, name, message, hint) in [
        ("antmaze", "antmaze-umaze", maze, "--task own-data"),
        ("walker2d", "walker2d", walker, "a task in walker2d-v5"),
        ("nested", "", group, "Dict of arrays"),
        ("discrete", "", discrete, "float32"),
    ] {
        let root = root(kind);
        let Some((_root, dataset)) = root else { return };
        assert_refused(&dataset, environment::find(name).ok(), message, hint);
    }
}

#[test]
fn damaged_metadata_and_missing_episodes() {
    let root = root("hopper");
    let Some((_root, dataset)) = root else { return };
    let metadata = dataset.join("data/metadata.json");
    let whole = fs::read_to_string(&metadata).unwrap();
    fs::write(&metadata, &whole[..whole.len() / 2]).unwrap();
    let message = format!("{}: cannot be understood", metadata.display());
    assert_refused(&dataset, Some(hopper()), &message, "metadata.json");

    fs::write(&metadata, whole).unwrap();
    let data = hdf5::File::open_rw(dataset.join("data/main_data.hdf5"));
    data.unwrap().unlink("episode_3").unwrap();
    let message = ": 3 episodes, but metadata.json says 4";
    assert_refused(&dataset, Some(hopper()), message, "again");
}

fn write_tuple(path: &Path) {
    let file = hdf5::File::create(path).unwrap();
    let episode = file.create_group("episode_0").unwrap();
    let observations = episode.create_group("observations").unwrap();
    for number in 0..11 {
        let array = format!("_index_{number}");
        put(&observations, &array, &[3, 1], &[number as f32; 3]);
    }
    put(&episode, "actions", &[2, 1], &[0.5f32; 2]);
    put(&episode, "rewards", &[2], &[1.0f32, 2.0]);
    put(&episode, "terminations", &[2], &[false, true]);
    put(&episode, "truncations", &[2], &[false; 2]);
}

#[test]
fn a_long_tuple_keeps_its_order_whatever_its_file_is_called() {
    let folder = tempdir().unwrap();
    for name in ["main_data.hdf5", "renamed.hdf5"] {
        let path = folder.path().join(name);
        write_tuple(&path);
        let batch = batch(&try_read(&path, None).unwrap());
        let expected = Vec::from_iter((0..11).map(|number| number as f32));
        assert_eq!(batch.observations[..11], expected, "{name}");
        assert_eq!(batch.rewards, [1.0, 2.0]);
    }
}
