use std::fs;
use std::path::{Path, PathBuf};

use hdf5::H5Type;
use hdf5::types::FixedAscii;
use ndarray::ArrayViewD;
use quad_dataset::{Problem, RecordedRows, RewardRule, Transitions};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tempfile::TempDir;

use crate::{assert_error, assert_refused, hopper, options, put, scratch, steps, try_read, write};

const ROWS: usize = 20;

fn subject() -> (TempDir, PathBuf) {
    let (folder, path) = scratch("subject.hdf5");
    let mut arrays = steps(ROWS, 11, 3);
    arrays.terminals[4] = true;
    write(&path, &arrays);
    (folder, path)
}

/// Checks all of the message after the path.
fn refused(path: &Path, message: &str) {
    let message = format!("{}: {message}", path.display());
    assert_refused(path, Some(hopper()), &message, "");
}

/// Changes a sound file, and checks the end of the message and a part of the hint.
fn spoiled(change: impl Fn(&hdf5::File), message: &str, hint: &str) {
    let (_folder, path) = subject();
    assert_eq!(try_read(&path, Some(hopper())).unwrap().len(), ROWS - 1);
    change(&hdf5::File::open_rw(&path).unwrap());
    assert_refused(&path, Some(hopper()), message, hint);
}

/// Replaces an array.
fn replaced<T: H5Type>(array: &str, shape: &[usize], data: &[T], message: &str, hint: &str) {
    let replace = |file: &hdf5::File| {
        file.unlink(array).unwrap();
        put(file, array, shape, data);
    };
    spoiled(replace, message, hint);
}

#[test]
fn what_is_no_dataset() {
    let error = try_read(Path::new("/nowhere/x.hdf5"), None).err().unwrap();
    assert!(matches!(error.problem, Problem::Io(_)), "{error}");
    let (_folder, path) = subject();
    let mut noise = vec![0; 5000];
    ChaCha8Rng::seed_from_u64(1).fill(&mut noise[..]);
    let neither = "neither an HDF5 file nor an npz archive";
    let damaged = "not an HDF5 file, or a damaged or incomplete one";
    let signature = b"\x89HDF\r\n\x1a\n";
    for (content, message) in [(&noise[..], neither), (b"", neither), (signature, damaged)] {
        fs::write(&path, content).unwrap();
        refused(&path, message);
    }
}

#[test]
fn truncated_anywhere() {
    let (_folder, path) = subject();
    let whole = fs::read(&path).unwrap();
    for length in (97..whole.len()).step_by(97) {
        fs::write(&path, &whole[..length]).unwrap();
        let message = format!("cut short: {length} bytes are there of {}", whole.len());
        refused(&path, &message);
    }
}

#[test]
fn damaged_inside_a_compressed_array() {
    let (_folder, path) = subject();
    let mut generator = ChaCha8Rng::seed_from_u64(2);
    let noise: Vec<f32> = (0..ROWS * 3).map(|_| generator.random()).collect();
    let file = hdf5::File::open_rw(&path).unwrap();
    file.unlink("actions").unwrap();
    let array = file.new_dataset::<f32>().chunk((ROWS, 3)).deflate(4);
    let array = array.shape((ROWS, 3)).create("actions").unwrap();
    let noise = ArrayViewD::from_shape([ROWS, 3].as_slice(), &noise);
    array.write(noise.unwrap()).unwrap();
    file.flush().unwrap();
    let chunk = array.chunk_info(0).unwrap();
    drop((array, file));
    try_read(&path, Some(hopper())).unwrap();

    let mut bytes = fs::read(&path).unwrap();
    bytes[chunk.addr as usize..(chunk.addr + chunk.size) as usize].reverse();
    fs::write(&path, bytes).unwrap();
    refused(&path, "array `actions` cannot be read");
}

#[test]
fn a_missing_array_and_what_is_in_its_place() {
    for array in ["observations", "actions", "rewards", "terminals"] {
        let message = format!("subject.hdf5: array `{array}` is missing");
        spoiled(|file| file.unlink(array).unwrap(), &message, "");
    }
    let rename = |file: &hdf5::File| file.relink("terminals", "dones").unwrap();
    let there = "in its place are actions, dones, observations, rewards, timeouts; ";
    spoiled(rename, "array `terminals` is missing", there);
    let group = |file: &hdf5::File| {
        file.unlink("rewards").unwrap();
        file.create_group("rewards").unwrap();
    };
    let message = "array `rewards` is a group of arrays, but must be an array";
    spoiled(group, message, "columns");
    let error = RecordedRows::read(subject().1, hopper()).err().unwrap();
    assert_error(&error, "array `infos/qpos` is missing", "");
}

#[test]
fn an_array_that_is_not_what_it_must_be() {
    let half = [0.5f32; ROWS * 17];
    let shape_is = |array: &str, shape: &[usize], message: &str, hint: &str| {
        let count: usize = shape.iter().product();
        replaced(array, shape, &half[..count], message, hint);
    };
    let message = "`observations` has 17 numbers a row, but `hopper` has 11";
    shape_is("observations", &[ROWS, 17], message, "");
    let message = "`actions` has 6 numbers a row, but `hopper` has 3";
    shape_is("actions", &[ROWS, 6], message, "");
    let message = "array `actions` has shape [3, 20], but must have 20 rows";
    shape_is("actions", &[3, ROWS], message, "f[n][()].T");
    let message = "array `actions` has shape [21, 3], but must have 20 rows";
    shape_is("actions", &[ROWS + 1, 3], message, "docs/data.md");
    let message = "array `rewards` has shape [19], but must have [20]";
    shape_is("rewards", &[ROWS - 1], message, "");
    let message = "array `terminals` has shape [20, 2], but must have [20]";
    shape_is("terminals", &[ROWS, 2], message, "");
    let message = "has shape [20, 1, 11], but must have rows, or rows of numbers";
    shape_is("observations", &[ROWS, 1, 11], message, "");
    let message = "array `actions` holds bool, but must hold numbers";
    replaced("actions", &[ROWS, 3], &[false; ROWS * 3], message, "");
    let message = "but must hold booleans (h5py's enum, or numbers that are 0 or 1)";
    let text: FixedAscii<4> = FixedAscii::from_ascii(b"true").unwrap();
    replaced("terminals", &[ROWS], &[text; ROWS], message, "");
    let message = "20 rows, of which none makes a transition";
    replaced("timeouts", &[ROWS], &[true; ROWS], message, "");
}

#[test]
fn a_number_that_is_not_what_it_must_be() {
    let mut unknown = [0.5f32; ROWS * 11];
    unknown[7 * 11 + 3] = f32::NAN;
    unknown[8 * 11..9 * 11].fill(f32::INFINITY);
    let message = "array `observations`, row 7: NaN is not a finite float32 (2 such rows)";
    replaced("observations", &[ROWS, 11], &unknown, message, "");
    let mut large = [0.5f64; ROWS];
    large[19] = 1e39;
    let message = "array `rewards`, row 19: inf is not a finite float32";
    replaced("rewards", &[ROWS], &large, message, "");
    // Rounding is no reason to refuse.
    let mut outside = [1.0009f32; ROWS * 3];
    outside[16..20].fill(-30.0);
    outside[59] = 1.002;
    let message = "array `actions`, row 5: the action -30 is outside [-1, 1] (3 such rows)";
    replaced("actions", &[ROWS, 3], &outside, message, "");
    for (value, read) in [(2, 2), (-1, -1), (256, 127)] {
        let mut flags = [0; ROWS];
        flags[3] = value;
        let message = format!("array `timeouts`, row 3: {read} is neither 0 nor 1");
        replaced("timeouts", &[ROWS], &flags, &message, "");
    }
}

#[test]
fn an_endless_episode() {
    let (_folder, path) = scratch("long.hdf5");
    write(&path, &steps(50, 11, 3));
    let message =
        |rows: usize| format!("{rows} rows without a terminal or timeout: one endless episode");
    let hint = "set `timeouts` to 1 at the last row of each";
    assert_refused(&path, None, &message(50), hint);
    write(&path, &steps(1000, 11, 3));
    // As many steps as Hopper allows.
    assert!(try_read(&path, Some(hopper())).is_ok());
    write(&path, &steps(1001, 11, 3));
    refused(&path, &message(1001));
    // Without `timeouts`, Hopper's time limit truncates.
    let file = hdf5::File::open_rw(&path).unwrap();
    file.unlink("timeouts").unwrap();
    drop(file);
    assert!(try_read(&path, Some(hopper())).is_ok());
}

#[test]
fn a_size_that_no_such_file_can_hold() {
    let (_folder, path) = subject();
    let file = hdf5::File::open_rw(&path).unwrap();
    file.unlink("observations").unwrap();
    let shape = [1usize << 50, 11];
    let array = file.new_dataset::<f32>().chunk((1024, 11)).shape(shape);
    array.create("observations").unwrap();
    drop(file);
    let bytes = fs::metadata(&path).unwrap().len();
    let claim = format!("claims the shape {shape:?}, more than a file of {bytes} bytes can hold");
    refused(&path, &format!("array `observations` {claim}"));
}

#[test]
fn returns_without_any_spread() {
    let (_folder, path) = scratch("subject.hdf5");
    let mut arrays = steps(ROWS, 11, 3);
    arrays.terminals[4] = true;
    arrays.rewards.fill(0.0);
    write(&path, &arrays);
    assert!(try_read(&path, Some(hopper())).is_ok());
    let options = options(Some(hopper()), RewardRule::Locomotion);
    let error = Transitions::read(&path, &options).err().unwrap();
    assert!(matches!(error.problem, Problem::SameReturns), "{error}");
}
