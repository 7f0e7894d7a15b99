//! Data that training must not touch, and places where nothing can be written: one sentence, a hint, exit code 1, and no
//! folder left behind.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use ndarray::{Array1, Array2};
use quad_dataset::{D4rlWriter, Metadata, Row, environment};
use quad_tests::process::{assert_refused, binary};
use tempfile::{TempDir, tempdir};

/// Arrays of Hopper's sizes in D4RL's layout, to be spoiled in one place.
struct Arrays {
    observations: Array2<f32>,
    actions: Array2<f32>,
    rewards: Array1<f32>,
    terminals: Array1<bool>,
    timeouts: Array1<bool>,
}

impl Arrays {
    fn new(rows: usize) -> Self {
        Self {
            observations: Array2::from_shape_fn((rows, 11), |(i, j)| ((i + j) as f32).sin()),
            actions: Array2::from_shape_fn((rows, 3), |(i, j)| ((i * j) as f32).cos()),
            rewards: Array1::from_shape_fn(rows, |i| i as f32),
            terminals: Array1::from_shape_fn(rows, |i| i % 100 == 99),
            timeouts: Array1::from_elem(rows, false),
        }
    }

    fn write(&self, path: &Path) {
        // A copy, because another test's child may have inherited the lock of the file that HDF5 writes.
        let written = path.with_extension("written");
        let file = hdf5::File::create(&written).unwrap();
        file.new_dataset_builder().with_data(&self.observations).create("observations").unwrap();
        file.new_dataset_builder().with_data(&self.actions).create("actions").unwrap();
        file.new_dataset_builder().with_data(&self.rewards).create("rewards").unwrap();
        file.new_dataset_builder().with_data(&self.terminals).create("terminals").unwrap();
        file.new_dataset_builder().with_data(&self.timeouts).create("timeouts").unwrap();
        drop(file);
        fs::copy(&written, path).unwrap();
    }
}

/// A folder with a dataset, good until it is spoiled.
struct Subject {
    folder: TempDir,
    dataset: PathBuf,
}

impl Subject {
    fn new(name: &str) -> Self {
        let folder = tempdir().unwrap();
        let dataset = folder.path().join(name);
        Self { folder, dataset }
    }

    fn of(rows: usize, spoil: impl FnOnce(&mut Arrays)) -> Self {
        let this = Self::new("data.hdf5");
        let mut arrays = Arrays::new(rows);
        spoil(&mut arrays);
        arrays.write(&this.dataset);
        this
    }

    fn train(&self, run_dir: &Path) -> Output {
        let arguments = ["train", "--preset", "hopper-demo", "--eval-interval", "0", "--steps", "1"];
        let mut command = Command::new(binary("learner"));
        command.args(arguments).arg("--dataset").arg(&self.dataset).arg("--run-dir").arg(run_dir);
        command.output().unwrap()
    }

    /// Trains, which must be refused with words of `sentence` and of `hint`.
    fn refused(&self, sentence: &str, hint: &str) {
        let run_dir = self.folder.path().join("run");
        let output = self.train(&run_dir);
        assert_refused(&output, sentence, hint);
        assert!(!run_dir.exists(), "{sentence}: a refused start leaves a folder behind");
    }
}

#[test]
fn the_subject_itself_is_whole() {
    let subject = Subject::of(400, |_| ());
    let run_dir = subject.folder.path().join("run");
    let output = subject.train(&run_dir);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn files_of_another_kind_and_broken_ones() {
    let subject = Subject::new("notes.hdf5");
    fs::write(&subject.dataset, "my notes").unwrap();
    subject.refused("notes.hdf5: neither an HDF5 file nor an npz archive", "docs/data.md");

    let subject = Subject::of(400, |_| ());
    let whole = fs::read(&subject.dataset).unwrap();
    fs::write(&subject.dataset, &whole[..whole.len() / 2]).unwrap();
    subject.refused(&format!("data.hdf5: cut short: {} bytes are there", whole.len() / 2), "fetch or copy it again");

    let subject = Subject::new("data.npz");
    fs::write(&subject.dataset, b"PK\x03\x04 and nothing else").unwrap();
    subject.refused("data.npz: a damaged or incomplete npz archive", "fetch or copy it again");

    let subject = Subject::new("minari");
    fs::create_dir(&subject.dataset).unwrap();
    subject.refused("minari: a folder without main_data.hdf5", "the folder of one Minari dataset");
    hdf5::File::create(subject.dataset.join("main_data.hdf5")).unwrap();
    fs::write(subject.dataset.join("metadata.json"), "{\"total_episodes\": ").unwrap();
    subject.refused("metadata.json: cannot be understood", "fetch the Minari dataset again");
}

#[test]
fn arrays_that_are_missing_or_do_not_fit() {
    let subject = Subject::of(400, |_| ());
    hdf5::File::open_rw(&subject.dataset).unwrap().unlink("observations").unwrap();
    subject.refused("data.hdf5: array `observations` is missing", "docs/data.md");
    let subject = Subject::of(400, |arrays| arrays.rewards = Array1::zeros(399));
    subject.refused("array `rewards` has shape [399], but must have [400, 1]", "the same number of rows");
    let subject = Subject::of(400, |arrays| arrays.observations = Array2::zeros((400, 17)));
    subject.refused("`observations` has 17 numbers a row, but `hopper` has 11", "a dataset of hopper");
}

#[test]
fn numbers_that_would_poison_it() {
    let subject = Subject::of(400, |arrays| arrays.rewards[7] = f32::NAN);
    subject.refused("array `rewards`, row 7: NaN is not a finite float32", "leave out or repair");
    let subject = Subject::of(400, |arrays| arrays.observations[[3, 2]] = f32::INFINITY);
    subject.refused("array `observations`, row 3: inf is not a finite float32", "leave out or repair");
    let subject = Subject::of(400, |arrays| arrays.actions[[5, 1]] = 30.0);
    subject.refused("array `actions`, row 5: the action 30 is outside [-1, 1]", "scale the actions");
}

#[test]
fn too_few_transitions_and_episodes() {
    Subject::of(0, |_| ()).refused("0 rows, of which none makes a transition", "record more");
    Subject::of(200, |_| ()).refused("199 transitions are fewer than a batch of 256", "batch_size");
    let subject = Subject::of(1500, |arrays| arrays.terminals.fill(false));
    subject.refused("1500 rows without any terminal or timeout", "set `timeouts` to 1");
}

#[test]
fn another_environments_recording() {
    let subject = Subject::new("walker.hdf5");
    let walker = environment::find("walker2d").unwrap();
    let mut writer = D4rlWriter::create(&subject.dataset, walker).unwrap();
    let (zeros, terminal) = ([0.0; 17], false);
    let row = Row {
        observation: &zeros,
        action: &zeros[..6],
        next_observation: &zeros,
        reward: 0.0,
        terminal,
        timeout: false,
        qpos: &zeros[..9],
        qvel: &zeros[..9],
    };
    (0..400).for_each(|_| writer.push(&row).unwrap());
    writer.finish(&Metadata { algorithm: "none", iteration: 0, seed: 0 }).unwrap();
    subject.refused("recorded in `walker2d`, which is not `hopper`", "choose a preset for walker2d");
}

#[test]
fn a_run_folder_that_cannot_be_made() {
    let subject = Subject::of(400, |_| ());
    let file = subject.folder.path().join("file");
    fs::write(&file, "in the way").unwrap();
    // Also for root, who may write anywhere else.
    for run_dir in [file.join("run"), PathBuf::from("/proc/run")] {
        assert_refused(&subject.train(&run_dir), run_dir.to_str().unwrap(), "--run-dir");
    }
}

#[test]
fn what_cannot_be_replayed() {
    let verify = |path: &Path| Command::new(binary("evaluator")).arg("verify-dataset").arg(path).output().unwrap();
    let subject = Subject::of(400, |_| ());
    assert_refused(&verify(&subject.dataset), "array `infos/qpos` is missing", "evaluator collect");
    let whole = fs::read(&subject.dataset).unwrap();
    fs::write(&subject.dataset, &whole[..whole.len() / 2]).unwrap();
    assert_refused(&verify(&subject.dataset), "cut short", "fetch or copy it again");
    fs::write(&subject.dataset, "my notes").unwrap();
    assert_refused(&verify(&subject.dataset), "neither an HDF5 file nor an npz archive", "docs/data.md");
}
