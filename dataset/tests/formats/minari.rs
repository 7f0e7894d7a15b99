use std::path::{Path, PathBuf};

use quad_dataset::{DatasetError, EnvironmentSpec, Transitions, environment, recorded_environment};
use tempfile::{TempDir, tempdir};

use crate::{all, compare, hopper, peers_in, put, shared, try_read};

struct Root(TempDir);

impl Root {
    fn new(kind: &str) -> Option<Self> {
        let this = Self(tempdir().unwrap());
        peers_in(this.0.path(), &["write-minari", kind, "made/up-v0"]).then_some(this)
    }

    fn dataset(&self) -> PathBuf {
        self.0.path().join("made/up-v0")
    }

    fn metadata(&self) -> PathBuf {
        self.dataset().join("data/metadata.json")
    }

    fn read(
        &self,
        environment: Option<&'static EnvironmentSpec>,
    ) -> Result<Transitions, DatasetError> {
        try_read(&self.dataset(), environment)
    }

    fn error(&self) -> DatasetError {
        self.read(Some(hopper())).err().unwrap()
    }
}

fn compare_with_minari(
    root: &Path,
    id: &str,
    kind: &str,
    environment: Option<&'static EnvironmentSpec>,
) {
    let folder = tempdir().unwrap();
    let out = folder.path().join("reference.hdf5");
    let arguments = ["minari-reference", kind, id, out.to_str().unwrap()];
    if peers_in(root, &arguments) {
        let dataset = root.join(id);
        for path in [dataset.clone(), dataset.join("data"), dataset.join("data/main_data.hdf5")] {
            compare(&path, environment, &out);
        }
    }
}

#[test]
fn observations_in_an_array() {
    let Some(root) = Root::new("hopper") else { return };
    assert_eq!(recorded_environment(root.dataset()).unwrap().as_deref(), Some("hopper"));
    compare_with_minari(root.0.path(), "made/up-v0", "hopper", Some(hopper()));
}

#[test]
fn another_simulation_is_learned_from_but_not_scored_in_ours() {
    for (kind, id, ours) in
        [("antmaze", "AntMaze_UMaze-v4", "antmaze-umaze"), ("walker2d", "Walker2d-v5", "walker2d")]
    {
        let Some(root) = Root::new(kind) else { return };
        assert_eq!(recorded_environment(root.dataset()).unwrap().as_deref(), Some(id));
        let error = root.read(environment::find(ours).ok()).err().unwrap();
        assert!(
            error.to_string().ends_with(&format!("recorded in `{id}`, which is not `{ours}`")),
            "{error}"
        );
        assert!(error.hint().contains("--task own-data"), "{}", error.hint());
        compare_with_minari(root.0.path(), "made/up-v0", kind, None);
    }
}

#[test]
fn a_dict_becomes_a_row_in_alphabetical_order_and_a_tuple_in_its_own() {
    for kind in ["own", "tuple"] {
        let Some(root) = Root::new(kind) else { return };
        assert_eq!(recorded_environment(root.dataset()).unwrap().as_deref(), Some("Robot-v0"));
        compare_with_minari(root.0.path(), "made/up-v0", kind, None);
    }
}

#[test]
fn a_dict_in_a_dict() {
    let Some(root) = Root::new("nested") else { return };
    let error = root.read(None).err().unwrap();
    let expected =
        "`episode_0/observations/achieved_goal` is a group of arrays, but must be an array";
    assert!(error.to_string().ends_with(expected), "{error}");
    assert!(error.hint().contains("Dict") && !error.hint().contains("damaged"), "{}", error.hint());
}

#[test]
fn a_dataset_that_minari_wrote_elsewhere() {
    if let Some(root) = shared("fixtures/minari_root") {
        compare_with_minari(&root, "mujoco/hopper/fixture-v0", "hopper", Some(hopper()));
    }
}

#[test]
fn damaged_metadata_and_missing_episodes() {
    let Some(root) = Root::new("hopper") else { return };
    let whole = std::fs::read_to_string(root.metadata()).unwrap();
    std::fs::write(root.metadata(), &whole[..whole.len() / 2]).unwrap();
    assert_eq!(
        root.error().to_string(),
        format!("{}: cannot be understood", root.metadata().display())
    );

    std::fs::write(root.metadata(), whole).unwrap();
    let data = root.dataset().join("data/main_data.hdf5");
    hdf5::File::open_rw(&data).unwrap().unlink("episode_3").unwrap();
    let text = root.error().to_string();
    assert!(text.ends_with(": 3 episodes, but metadata.json says 4"), "{text}");
}

fn write_tuple(path: &Path) {
    let file = hdf5::File::create(path).unwrap();
    let observations =
        file.create_group("episode_0").unwrap().create_group("observations").unwrap();
    for number in 0..11 {
        put(&observations, &format!("_index_{number}"), &[3, 1], &[number as f32; 3]);
    }
    put(&file, "episode_0/actions", &[2, 1], &[0.5f32; 2]);
    put(&file, "episode_0/rewards", &[2], &[1.0f32, 2.0]);
    put(&file, "episode_0/terminations", &[2], &[false, true]);
    put(&file, "episode_0/truncations", &[2], &[false; 2]);
}

#[test]
fn a_long_tuple_keeps_its_order_whatever_its_file_is_called() {
    let folder = tempdir().unwrap();
    for name in ["main_data.hdf5", "renamed.hdf5"] {
        let path = folder.path().join(name);
        write_tuple(&path);
        let batch = all(&try_read(&path, None).unwrap());
        assert_eq!(
            batch.observations[..11],
            Vec::from_iter((0..11).map(|number| number as f32)),
            "{name}"
        );
        assert_eq!(batch.rewards, [1.0, 2.0]);
    }
}
