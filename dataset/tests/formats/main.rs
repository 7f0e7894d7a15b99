//! Readers and writers on files of h5py, Minari and OGBench, on recorded and on damaged ones.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::path::{Path, PathBuf};
use std::process::Command;

use hdf5::H5Type;
use ndarray::ArrayViewD;
use quad_dataset::benchmarks::relabeling;
use quad_dataset::{
    Arrays, Batch, DatasetError, EnvironmentSpec, Normalize, ReadOptions, RewardRule, Transitions,
    environment,
};
use tempfile::{TempDir, tempdir};

mod broken;
mod d4rl;
mod foreign;
mod inspect;
mod joined;
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
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let path = here.join("../../shared").join(path);
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

/// What to normalize, by letters: actions, observations, rewards.
fn normalize(columns: &str) -> Normalize {
    let [actions, observations, rewards] = ["a", "o", "r"].map(|letter| columns.contains(letter));
    Normalize { actions, observations, rewards }
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
    let (text, advice) = (error.to_string(), error.hint());
    assert!(text.ends_with(message), "{text}, not {message}");
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
    let builder = file.new_dataset_builder().with_data(view);
    builder.create(array).unwrap();
}

fn batch(transitions: &Transitions) -> Batch {
    transitions.gather(&Vec::from_iter(0..transitions.len() as u32))
}

fn compare(path: &Path, environment: Environment, reference: &Path) {
    let reference = hdf5::File::open(reference).unwrap();
    let array = |name: &str| reference.dataset(name).unwrap().read_raw::<f32>().unwrap();

    let recorded = batch(&read(path, environment, RewardRule::AsIs));
    assert_eq!(recorded.rewards, array("raw_rewards"));
    let transitions = read(path, environment, RewardRule::Locomotion);
    let batch = batch(&transitions);
    assert_eq!(batch.steps.len(), transitions.len());
    assert_eq!(batch.observations, array("observations"));
    assert_eq!(batch.actions, array("actions"));
    assert_eq!(batch.next_observations, array("next_observations"));
    assert_eq!(batch.masks, array("masks"));
    assert_close("rewards", &batch.rewards, &array("rewards"));

    let ours = transitions.statistics();
    let counts = [ours.transitions as f64, ours.episodes as f64];
    let returns = [ours.return_mean, ours.return_min, ours.return_max];
    let figures = [&counts[..], &returns].concat();
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
        let python = python.display();
        assert!(!required, "{python} is missing; deploy/setup.sh --tests makes it");
        eprintln!("skipped, because {python} is missing");
        return false;
    }
    let mut command = Command::new(python);
    command.arg(here.join("tests/formats/peers.py"));
    command.args(arguments).current_dir(folder);
    command.env("MINARI_DATASETS_PATH", folder);
    let output = command.output().unwrap();
    let complaint = String::from_utf8_lossy(&output.stderr);
    let has_run = output.status.success();
    assert!(has_run, "peers.py {arguments:?}:\n{complaint}");
    true
}
