use std::fs;
use std::path::Path;

use quad_dataset::{
    D4rlWriter, Metadata, OnlineEpisode, RecordedRows, RewardRule, Row, environment,
    recorded_environment, write_experience,
};

use crate::{all, assert_error, hopper, peers, read, scratch};

const ROWS: usize = 10_000;
const METADATA: Metadata<'_> = Metadata { algorithm: "formula", iteration: 12, seed: 34 };

/// Numbers exact in float32; `peers.py check-written` has the same formulas.
struct OwnedRow([Vec<f64>; 5]);

impl OwnedRow {
    fn new(i: usize) -> Self {
        let list =
            |n: usize, value: &dyn Fn(f64) -> f64| Vec::from_iter((0..n).map(|j| value(j as f64)));
        let i = i as f64;
        Self([
            list(11, &|j| i + j / 16.0),
            list(3, &|j| ((i * 3.0 + j) % 7.0 - 3.0) / 4.0),
            list(11, &|j| i + 1.0 + j / 16.0),
            list(6, &|j| -i - j / 16.0),
            list(6, &|j| j - i / 32.0),
        ])
    }

    fn row(&self, i: usize) -> Row<'_> {
        let [observation, action, next_observation, qpos, qvel] = &self.0;
        let (reward, terminal, timeout) = (i as f64 / 8.0, i % 50 == 49, i % 70 == 69);
        Row { observation, action, next_observation, reward, terminal, timeout, qpos, qvel }
    }
}

fn writer(path: &Path, rows: usize) -> D4rlWriter {
    let mut writer = D4rlWriter::create(path, hopper()).unwrap();
    for i in 0..rows {
        writer.push(&OwnedRow::new(i).row(i)).unwrap();
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
        assert_eq!(row, OwnedRow::new(i).row(i), "row {i}");
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
    let good = OwnedRow::new(1);
    let short = Row { action: &[0.0; 2], ..good.row(1) };
    let message = "`actions` has 2 numbers a row, but `hopper` has 3";
    assert_error(&writer.push(&short).unwrap_err(), message, "");
    for (value, found) in [(f64::NAN, "NaN"), (f64::INFINITY, "inf"), (1e39, "inf")] {
        let row = Row { qvel: &[0.0, 0.0, value, 0.0, 0.0, 0.0], ..good.row(1) };
        let message = format!("array `infos/qvel`, row 1: {found} is not a finite float32");
        assert_error(&writer.push(&row).unwrap_err(), &message, "");
    }
    assert_written(writer, &path, 1);
}

#[test]
fn experience_is_read_as_it_was_played() {
    let (_folder, path) = scratch("experience.hdf5");
    let numbers = |from: f32, count: usize| Vec::from_iter((0..count).map(|i| from + i as f32));
    let (long, short, actions) = (numbers(0.0, 4 * 29), numbers(500.0, 3 * 29), vec![0.5; 3 * 8]);
    let episode = |observations, rewards: &'static [f32], terminated| OnlineEpisode {
        observations,
        actions: &actions[..rewards.len() * 8],
        rewards,
        terminated,
    };
    let failed = (episode(&long, &[0.0; 3], false), &[0, 2][..]);
    let reached = (episode(&short, &[0.0, 1.0], true), &[][..]);
    let umaze = environment::find("antmaze-umaze").unwrap();
    let episodes = [failed, reached, reached, failed];
    write_experience(&path, &umaze.name, (29, 8), &METADATA, &episodes).unwrap();
    assert_eq!(recorded_environment(&path).unwrap().as_deref(), Some("antmaze-umaze"));
    let transitions = read(&path, Some(umaze), RewardRule::AsIs);
    // Each truncated episode's last step makes no transition.
    assert_eq!(transitions.recorded_episodes(), [0..2, 2..4, 4..6, 6..8]);
    assert_eq!(transitions.statistics().score_mean, Some(50.0));
    let batch = all(&transitions);
    assert_eq!(batch.masks, [1.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 1.0]);
    assert_eq!(batch.observations[2 * 29..4 * 29], short[..2 * 29]);
    assert_eq!(batch.next_observations[..2 * 29], long[29..3 * 29]);
    let file = hdf5::File::open(&path).unwrap();
    let marks = file.dataset("infos/intervention").unwrap().read_raw::<bool>().unwrap();
    let marked = [true, false, true];
    assert_eq!(marks, [&marked[..], &[false; 4], &marked].concat());

    let error = write_experience(&path, "ant", (27, 8), &METADATA, &episodes).unwrap_err();
    assert_error(&error, "array `observations` has shape [116], but must have [4, 27]", "");
}
