use std::fs;
use std::path::Path;

use quad_dataset::{
    D4rlWriter, Metadata, OnlineEpisode, RecordedRows, RecordedStep, RewardRule, environment,
    recorded_environment, write_experience,
};

use crate::{assert_error, batch, hopper, peers, read, scratch};

const ROWS: usize = 10_000;
const METADATA: Metadata<'_> = Metadata {
    algorithm: "formula",
    iteration: 12,
    seed: 34,
    run: Some("mine"),
    weights: Some("0f"),
};

/// The numbers of row `i`, exact in float32; `peers.py check-written` has the same formulas.
fn numbers(i: usize) -> [Vec<f64>; 5] {
    let i = i as f64;
    let numbers =
        |n: u32, value: &dyn Fn(f64) -> f64| (0..n).map(|j| value(f64::from(j))).collect();
    [
        numbers(11, &|j| i + j / 16.0),
        numbers(3, &|j| ((i * 3.0 + j) % 7.0 - 3.0) / 4.0),
        numbers(11, &|j| i + 1.0 + j / 16.0),
        numbers(6, &|j| -i - j / 16.0),
        numbers(6, &|j| j - i / 32.0),
    ]
}

fn step(i: usize, numbers: &[Vec<f64>; 5]) -> RecordedStep<'_> {
    RecordedStep {
        observation: &numbers[0],
        action: &numbers[1],
        next_observation: &numbers[2],
        reward: i as f64 / 8.0,
        terminal: i % 50 == 49,
        timeout: i % 70 == 69,
        qpos: &numbers[3],
        qvel: &numbers[4],
    }
}

fn writer(path: &Path, rows: usize) -> D4rlWriter {
    let mut writer = D4rlWriter::create(path, hopper()).unwrap();
    for i in 0..rows {
        writer.push(&step(i, &numbers(i))).unwrap();
    }
    assert_eq!(writer.rows(), rows);
    writer
}

/// Finishes a file, and checks that these many rows are read bit for bit.
fn assert_written(writer: D4rlWriter, path: &Path, rows: usize) {
    writer.finish(&METADATA).unwrap();
    let recorded = RecordedRows::read(path, hopper()).unwrap();
    assert_eq!(recorded.len(), rows);
    for (i, row) in recorded.iter().enumerate() {
        assert_eq!(row, step(i, &numbers(i)), "row {i}");
    }
}

#[test]
fn the_reader_reads_every_row_bit_for_bit_and_h5py_the_layout_of_d4rl() {
    let (_folder, path) = scratch("new/folder/rows.hdf5");
    assert_written(writer(&path, ROWS), &path, ROWS);
    peers(&["check-written", path.to_str().unwrap(), &ROWS.to_string()]);
}

#[test]
fn the_file_has_its_name_only_when_it_is_finished() {
    let (folder, path) = scratch("rows.hdf5");
    let partial = folder.path().join("rows.hdf5.partial");
    fs::write(&path, "an older file").unwrap();
    fs::write(&partial, "what an interrupted run left").unwrap();
    drop(writer(&path, 1));
    assert_eq!(fs::read_to_string(&path).unwrap(), "an older file");
    assert!(partial.exists());
    let writer = writer(&path, 1);
    assert_eq!(fs::read_to_string(&path).unwrap(), "an older file");
    assert_written(writer, &path, 1);
    assert!(!partial.exists());
}

#[test]
fn a_row_that_would_spoil_the_file_is_refused_as_a_whole() {
    let (_folder, path) = scratch("rows.hdf5");
    let mut writer = writer(&path, 1);
    let mut numbers = numbers(1);
    let mut refused = |column: usize, row: Vec<f64>, message: &str| {
        let good = std::mem::replace(&mut numbers[column], row);
        assert_error(&writer.push(&step(1, &numbers)).unwrap_err(), message, "");
        numbers[column] = good;
    };
    let message = "`actions` has 2 numbers a row, but `hopper` has 3";
    refused(1, vec![0.0; 2], message);
    let message = "array `infos/qvel`, row 1: NaN is not a finite float32";
    refused(4, vec![0.0, 0.0, f64::NAN, 0.0, 0.0, 0.0], message);
    for value in [f64::INFINITY, 1e39] {
        let message = "array `infos/qvel`, row 1: inf is not a finite float32";
        refused(4, vec![value; 6], message);
    }
    assert_written(writer, &path, 1);
}

#[test]
fn experience_is_read_as_it_was_played() {
    let (_folder, path) = scratch("experience.hdf5");
    let numbers = |from: f32, count: usize| Vec::from_iter((0..count).map(|i| from + i as f32));
    let (long, short) = (numbers(0.0, 4 * 29), numbers(500.0, 3 * 29));
    let episode = |observations, rewards: &'static [f32], terminated| OnlineEpisode {
        observations,
        actions: &[0.5; 3 * 8][..rewards.len() * 8],
        rewards,
        terminated,
    };
    let failed = (episode(&long, &[0.0; 3], false), &[0, 2][..]);
    let reached = (episode(&short, &[0.0, 1.0], true), &[][..]);
    let umaze = environment::find("antmaze-umaze").unwrap();
    let episodes = [failed, reached, reached, failed];
    write_experience(&path, &umaze.name, (29, 8), &METADATA, &episodes).unwrap();
    let recorded = recorded_environment(&path).unwrap().unwrap();
    assert_eq!(recorded, "antmaze-umaze");
    let transitions = read(&path, Some(umaze), RewardRule::AsIs);
    // Each truncated episode's last step makes no transition.
    assert_eq!(transitions.recorded_episodes(), [0..2, 2..4, 4..6, 6..8]);
    assert_eq!(transitions.statistics().score_mean, Some(50.0));
    let batch = batch(&transitions);
    assert_eq!(batch.masks, [1.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 1.0]);
    assert_eq!(batch.observations[2 * 29..4 * 29], short[..2 * 29]);
    assert_eq!(batch.next_observations[..2 * 29], long[29..3 * 29]);
    let file = hdf5::File::open(&path).unwrap();
    let marks = file.dataset("infos/intervention").unwrap();
    let marked = [true, false, true];
    let expected = [&marked[..], &[false; 4], &marked].concat();
    assert_eq!(marks.read_raw::<bool>().unwrap(), expected);

    let error = write_experience(&path, "ant", (27, 8), &METADATA, &episodes).unwrap_err();
    let message = "array `observations` has shape [116], but must have [4, 27]";
    assert_error(&error, message, "");
}
