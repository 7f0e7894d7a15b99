//! Readers and writers on files of h5py, Minari and OGBench, on recorded and on damaged ones.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::path::{Path, PathBuf};
use std::process::Command;

use hdf5::H5Type;
use ndarray::ArrayViewD;
use quad_dataset::benchmarks::relabeling;
use quad_dataset::{
    Arrays, Batch, DatasetError, EnvironmentSpec, ReadOptions, RewardRule, Transitions, environment,
};
use tempfile::{TempDir, tempdir};

mod broken;
mod d4rl;
mod foreign;
mod inspect;
mod minari;
mod normalize;
mod ogbench;
mod own;
mod round_trip;
mod warnings;

type Environment = Option<&'static EnvironmentSpec>;

fn hopper() -> &'static EnvironmentSpec {
    environment::find("hopper").unwrap()
}

/// Folder of recordings next to the repository, if present.
fn shared(path: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared").join(path);
    let exists = path.exists();
    if !exists {
        eprintln!("skipped, because {} is missing", path.display());
    }
    exists.then_some(path)
}

/// Folder with the path of a file in it.
fn scratch(name: &str) -> (TempDir, PathBuf) {
    let folder = tempdir().unwrap();
    let path = folder.path().join(name);
    (folder, path)
}

fn options(environment: Environment, reward: RewardRule) -> ReadOptions {
    let task = environment.and_then(|environment| relabeling(&environment.name));
    ReadOptions { environment, task, reward, ..ReadOptions::default() }
}

fn read(path: &Path, environment: Environment, reward: RewardRule) -> Transitions {
    Transitions::read(path, &options(environment, reward)).unwrap()
}

fn try_read(path: &Path, environment: Environment) -> Result<Transitions, DatasetError> {
    Transitions::read(path, &options(environment, RewardRule::AsIs))
}

fn assert_refused(path: &Path, environment: Environment, message: &str, hint: &str) {
    let error = try_read(path, environment).err().expect(message);
    assert_error(&error, message, hint);
}

/// Checks the end of a message and a part of its hint.
fn assert_error(error: &DatasetError, message: &str, hint: &str) {
    let (found, advice) = (error.to_string(), error.hint());
    assert!(found.ends_with(message), "{found}, not {message}");
    assert!(advice.contains(hint), "{advice}, not {hint}");
}

/// Steps of equal numbers within [-1, 1], without an end.
fn steps(rows: usize, observation_dim: usize, action_dim: usize) -> Arrays {
    Arrays {
        observation_dim,
        action_dim,
        observations: vec![0.5; rows * observation_dim],
        actions: vec![0.5; rows * action_dim],
        rewards: vec![1.0; rows],
        next_observations: vec![0.5; rows * observation_dim],
        terminals: vec![false; rows],
        timeouts: vec![false; rows],
    }
}

/// Writes D4RL's layout without next observations.
fn write(path: &Path, arrays: &Arrays) -> hdf5::File {
    let (file, rows) = (hdf5::File::create(path).unwrap(), arrays.rewards.len());
    let (o, a) = (arrays.observation_dim, arrays.action_dim);
    put(&file, "observations", &[rows, o], &arrays.observations);
    put(&file, "actions", &[rows, a], &arrays.actions);
    put(&file, "rewards", &[rows], &arrays.rewards);
    put(&file, "terminals", &[rows], &arrays.terminals);
    put(&file, "timeouts", &[rows], &arrays.timeouts);
    file
}

fn put<T: H5Type>(file: &hdf5::Group, array: &str, shape: &[usize], data: &[T]) {
    let view = ArrayViewD::from_shape(shape, data).unwrap();
    file.new_dataset_builder().with_data(view).create(array).unwrap();
}

fn all(transitions: &Transitions) -> Batch {
    transitions.gather(&Vec::from_iter(0..transitions.len() as u32))
}

fn compare(path: &Path, environment: Environment, reference: &Path) {
    let reference = hdf5::File::open(reference).unwrap();
    let array = |name: &str| reference.dataset(name).unwrap().read_raw::<f32>().unwrap();

    let transitions = read(path, environment, RewardRule::Locomotion);
    let batch = all(&transitions);
    assert_eq!(batch.rewards.len(), transitions.len());
    assert_eq!(batch.observations, array("observations"));
    assert_eq!(batch.actions, array("actions"));
    assert_eq!(batch.next_observations, array("next_observations"));
    assert_eq!(batch.masks, array("masks"));
    assert_close("rewards", &batch.rewards, &array("rewards"));
    assert_eq!(all(&read(path, environment, RewardRule::AsIs)).rewards, array("raw_rewards"));

    let ours = transitions.statistics();
    let figures = [
        ours.transitions as f64,
        ours.episodes as f64,
        ours.return_mean,
        ours.return_min,
        ours.return_max,
    ];
    let theirs = reference.dataset("statistics").unwrap();
    for (ours, theirs) in figures.iter().zip(theirs.read_raw::<f64>().unwrap()) {
        assert!((ours - theirs).abs() <= 1e-9 * theirs.abs(), "{figures:?}");
    }
    let score = environment.map(|spec| spec.normalized_score(ours.return_mean));
    assert_eq!(ours.score_mean, score);
}

fn assert_close(name: &str, ours: &[f32], theirs: &[f32]) {
    let is_close =
        |(ours, theirs): (&f32, &f32)| (ours - theirs).abs() <= 1e-6 * theirs.abs().max(1e-3);
    assert_eq!(ours.len(), theirs.len(), "{name}");
    let apart = ours.iter().zip(theirs).position(|pair| !is_close(pair));
    assert_eq!(apart, None, "{name}: {ours:?} against {theirs:?}");
}

/// A file that `peers.py` writes by a command with a variant; see [`peers`].
fn written(command: &str, variant: &str, name: &str) -> Option<(TempDir, PathBuf)> {
    let (folder, path) = scratch(name);
    peers(&[command, variant, path.to_str().unwrap()]).then_some((folder, path))
}

/// Runs `peers.py`. Without Python it returns false, or panics if QUAD_REQUIRE_PEERS=1.
fn peers(arguments: &[&str]) -> bool {
    peers_in(Path::new("."), arguments)
}

/// Runs `peers.py` in another folder, which is also Minari's root.
fn peers_in(folder: &Path, arguments: &[&str]) -> bool {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = match std::env::var_os("QUAD_PYTHON") {
        Some(python) => PathBuf::from(python),
        None => here.join("../.deps/venv/bin/python"),
    };
    if !python.exists() {
        let required = std::env::var("QUAD_REQUIRE_PEERS").is_ok_and(|value| value == "1");
        assert!(!required, "{} is missing; deploy/setup.sh --tests makes it", python.display());
        eprintln!("skipped, because {} is missing", python.display());
        return false;
    }
    let mut command = Command::new(python);
    command.arg(here.join("tests/formats/peers.py")).args(arguments);
    command.current_dir(folder).env("MINARI_DATASETS_PATH", folder);
    let output = command.output().unwrap();
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "peers.py {arguments:?}:\n{complaint}");
    true
}
