use std::fs;
use std::path::Path;

use quad_dataset::{D4rlWriter, Metadata, RecordedRows, Row};

use crate::{assert_error, hopper, peers, scratch};

const ROWS: usize = 10_000;

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
    writer.finish(&Metadata { algorithm: "formula", iteration: 12, seed: 34 }).unwrap();
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
