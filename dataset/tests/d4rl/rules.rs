//! The rules that turn rows into transitions, against NumPy.

use std::path::Path;

use ndarray::Array2;
use quad_dataset::{Batch, BatchSampler, ReadOptions, RewardRule, Transitions};
use tempfile::tempdir;

use crate::{hopper, peers};

fn read(path: &Path, reward: RewardRule) -> Transitions {
    Transitions::read(path, &ReadOptions { environment: Some(hopper()), reward }).unwrap()
}

fn all(transitions: &Transitions) -> Batch {
    let indices: Vec<u32> = (0..transitions.len() as u32).collect();
    let mut batch = Batch::default();
    transitions.gather(&indices, &mut batch);
    batch
}

fn assert_close(name: &str, ours: &[f32], theirs: &[f32]) {
    assert_eq!(ours.len(), theirs.len(), "{name}");
    for (i, (ours, theirs)) in ours.iter().zip(theirs).enumerate() {
        assert!((ours - theirs).abs() <= 1e-6 * theirs.abs().max(1e-3), "{name} {i}: {ours} against {theirs}");
    }
}

/// Compares every transition of a file, and its statistics, with what `peers.py reference` finds in it.
fn compare(path: &Path) {
    let folder = tempdir().unwrap();
    let out = folder.path().join("reference.hdf5");
    if !peers(&["reference", path.to_str().unwrap(), out.to_str().unwrap()]) {
        return;
    }
    let reference = hdf5::File::open(&out).unwrap();
    let array = |name: &str| reference.dataset(name).unwrap().read_raw::<f32>().unwrap();

    let transitions = read(path, RewardRule::Locomotion);
    let batch = all(&transitions);
    assert_eq!(batch.size, transitions.len());
    assert_eq!(batch.observations, array("observations"));
    assert_eq!(batch.actions, array("actions"));
    assert_eq!(batch.next_observations, array("next_observations"));
    assert_eq!(batch.masks, array("masks"));
    assert_close("rewards", &batch.rewards, &array("rewards"));
    assert_eq!(all(&read(path, RewardRule::AsIs)).rewards, array("raw_rewards"));

    let ours = transitions.statistics();
    let figures = [ours.transitions as f64, ours.episodes as f64, ours.return_mean, ours.return_min, ours.return_max];
    let theirs = reference.dataset("statistics").unwrap().read_raw::<f64>().unwrap();
    for (ours, theirs) in figures.iter().zip(&theirs) {
        assert!((ours - theirs).abs() <= 1e-9 * theirs.abs(), "{figures:?} against {theirs:?}");
    }
    assert_eq!(ours.score_mean, Some(hopper().normalised_score(ours.return_mean)));
}

fn compare_generated(variant: &str) {
    let folder = tempdir().unwrap();
    let path = folder.path().join("generated.hdf5");
    if peers(&["generate", variant, path.to_str().unwrap()]) {
        compare(&path);
    }
}

#[test]
fn terminals_timeouts_and_both() {
    compare_generated("plain");
}

#[test]
fn double_precision_as_in_replay_files() {
    compare_generated("float64");
}

#[test]
fn rewards_and_flags_of_shape_n_by_1() {
    compare_generated("columns");
}

#[test]
fn flags_as_integers() {
    compare_generated("integers");
}

#[test]
fn timeouts_from_the_time_limit() {
    compare_generated("no-timeouts");
}

#[test]
fn recorded_files() {
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared");
    for name in ["data/hopper_medium_replay.hdf5", "fixtures/hopper_fixture-v2.hdf5"] {
        let path = shared.join(name);
        if path.exists() {
            compare(&path);
        } else {
            eprintln!("skipped, because {} is missing", path.display());
        }
    }
}

#[test]
fn a_sampler_fills_batches_with_each_transition_once_a_pass() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("rows.hdf5");
    let file = hdf5::File::create(&path).unwrap();
    let rows: usize = 8;
    let write = |name: &str, width: usize, value: &dyn Fn(usize) -> f32| {
        let data = Array2::from_shape_fn((rows, width), |(i, _)| value(i));
        file.new_dataset_builder().with_data(&data).create(name).unwrap();
    };
    write("observations", 11, &|i| i as f32);
    write("actions", 3, &|i| i as f32 - 3.0);
    write("rewards", 1, &|i| i as f32);
    file.new_dataset_builder()
        .with_data(&[false, false, true, false, false, false, false, false])
        .create("terminals")
        .unwrap();
    drop(file);

    let transitions = read(&path, RewardRule::AsIs);
    assert_eq!((transitions.len(), transitions.observation_dim(), transitions.action_dim()), (7, 11, 3));
    let mut sampler = BatchSampler::new(transitions.len(), 3, 5, 0);
    let mut batch = Batch::default();
    let mut drawn = Vec::new();
    for _ in 0..7 {
        sampler.next(&transitions, &mut batch);
        assert_eq!(batch.size, 3);
        for k in 0..3 {
            let i = batch.observations[11 * k] as usize;
            assert_eq!(batch.observations[11 * k..11 * (k + 1)], [i as f32; 11]);
            assert_eq!(batch.next_observations[11 * k..11 * (k + 1)], [i as f32 + 1.0; 11]);
            assert_eq!(batch.actions[3 * k..3 * (k + 1)], [(i as f32 - 3.0).clamp(-0.99999, 0.99999); 3]);
            assert_eq!(batch.rewards[k], i as f32);
            assert_eq!(batch.masks[k], if i == 2 { 0.0 } else { 1.0 });
            drawn.push(i);
        }
    }
    for pass in drawn.chunks(7) {
        let mut pass = pass.to_vec();
        pass.sort_unstable();
        assert_eq!(pass, [0, 1, 2, 3, 4, 5, 6]);
    }
}
