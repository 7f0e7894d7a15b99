use std::fs;
use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use ndarray::Array2;
use npyz::WriterBuilder;
use npyz::half::f16;
use quad_dataset::{ArrayProblem, Problem, RewardRule, data_file, inspect};
use tempfile::{TempDir, tempdir};
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

use crate::{assert_refused, batch, put, read, scratch};

const ROWS: usize = 300;

fn zip(file: &str) -> Vec<u8> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default();
    archive.start_file(file, options).unwrap();
    archive.finish().unwrap().into_inner()
}

/// Checks the start of a message after the path, and a part of its hint.
fn assert_named(path: &Path, what: &str, hint: &str) {
    let error = inspect(&[path], None).err().unwrap();
    let (text, advice) = (error.problem.to_string(), error.hint());
    assert!(text.starts_with(what), "{text}, not {what}");
    assert!(advice.contains(hint), "{advice}, not {hint}");
}

#[test]
fn files_of_other_formats_are_named() {
    const NEITHER: &str = "neither an HDF5 file nor an npz archive";
    let (_folder, path) = scratch("log");
    let pointer = b"version https://git-lfs.github.com/spec/v1\noid";
    for (content, what, hint) in [
        (&pointer[..], "a pointer of Git LFS,", "git lfs pull"),
        (b"<!DOCTYPE html><title>", "a web page, or other XML", "its own link"),
        (b"\x1f\x8b\x08\0\0", "a file compressed by gzip", "gunzip"),
    ] {
        fs::write(&path, content).unwrap();
        assert_named(&path, what, hint);
    }
    for (content, what) in [
        (&b"PAR1\0\0\0\0PAR1"[..], "a Parquet file"),
        (b"ARROW1\0\0", "an Arrow file"),
        (b"\x80\x04\x95\xed\0\0", "a Python pickle"),
        (b"\x93NUMPY\x01\0", "a single NumPy array"),
        (b"MATLAB 7.3 MAT-file, Platform: GLNXA64", "a MATLAB file"),
        (b"{\"observations\": [[0.1, 0.2]]}", "a JSON file"),
        (b"episode,obs0,reward\n0,0.1,1.0\n", "a table as text (CSV)"),
        ("Höhe;Länge\n0,1;0,2\n".as_bytes(), "a table as text (CSV)"),
        (b"0.1\t0.2\n", "a table as text (CSV)"),
        (b"#ROSBAG V2.0\n\x45\0\0\0", "a ROS bag"),
        (b"\x89MCAP0\r\n\x01", "an MCAP file"),
        (b"SQLite format 3\0\x10\0", "a SQLite database"),
        (&zip("policy/data.pkl"), "a PyTorch file"),
        (&zip("timeouts.npy"), "an npz archive with `timeouts`"),
        (&zip("readme.txt"), NEITHER),
        (b"nothing that is known\n", NEITHER),
        (b"\0,\0,", NEITHER),
        (b"\xff\xfe,,", NEITHER),
    ] {
        fs::write(&path, content).unwrap();
        assert_named(&path, what, "docs/data.md");
    }
}

#[test]
fn folders_of_other_formats_are_named() {
    let lerobot = "a LeRobot dataset of version v3.0,";
    let lerobot_info = r#"{"codebase_version": "v3.0"}"#;
    let [arrow, parquet] =
        ["arrow", "parquet"].map(|format| format!(r#"{{"data_format": "{format}"}}"#));
    for (file, text, what) in [
        ("meta/info.json", lerobot_info, lerobot),
        ("data/metadata.json", &arrow, "a Minari dataset stored as arrow"),
        ("metadata.json", &parquet, "a Minari dataset stored as parquet"),
        (".zgroup", "", "a Zarr store"),
        ("zarr.json", "", "a Zarr store"),
        ("features.json", "", "a dataset of TensorFlow"),
        ("metadata.yaml", "", "a ROS 2 bag"),
    ] {
        let (folder, path) = scratch(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
        assert_named(folder.path(), what, "docs/data.md");
    }
    let empty = tempdir().unwrap();
    let problem = data_file(empty.path()).unwrap_err().problem;
    assert!(matches!(problem, Problem::UnknownFolder), "{problem}");
}

#[test]
fn a_robomimic_file_is_named() {
    let (_folder, path) = scratch("low_dim.hdf5");
    let layout = "a file in robomimic's layout without rewards, as Isaac Lab's recorder writes it";
    let whole = (&["actions", "rewards"][..], "a robomimic file");
    for (arrays, what) in [whole, (&["actions"], layout)] {
        let file = hdf5::File::create(&path).unwrap();
        file.create_group("data/demo_0").unwrap();
        for array in arrays {
            put(&file, &format!("data/demo_0/{array}"), &[3], &[0f32; 3]);
        }
        drop(file);
        assert_named(&path, what, "quad-convert FILE --observations KEY …");
    }
    assert_named(&path, layout, "--reward success-at-end --success all");
}

/// A file whose arrays `write` puts.
fn file(write: impl Fn(&hdf5::File, &str, &Array2<f32>)) -> (TempDir, PathBuf) {
    let (folder, path) = scratch("log.hdf5");
    let file = hdf5::File::create(&path).unwrap();
    // Multiples of 1/4 are exact in half precision.
    let quarters = |(i, j)| ((i + j) % 4) as f32 / 4.0;
    for (name, width) in [("observations", 3), ("actions", 2), ("rewards", 1)] {
        write(&file, name, &Array2::from_shape_fn((ROWS, width), quarters));
    }
    let terminals = Array2::from_shape_fn((ROWS, 1), |(i, _)| f32::from(u8::from(i == 7)));
    write(&file, "terminals", &terminals);
    (folder, path)
}

fn plain(file: &hdf5::File, name: &str, values: &Array2<f32>) {
    let builder = file.new_dataset_builder().with_data(values);
    builder.create(name).unwrap();
}

fn lzf(file: &hdf5::File, name: &str, values: &Array2<f32>) {
    let builder = file.new_dataset_builder().with_data(values);
    let builder = builder.chunk((100, values.ncols())).shuffle();
    builder.lzf().create(name).unwrap();
}

#[test]
fn half_precision_and_lzf_are_read() {
    let half = |file: &hdf5::File, name: &str, values: &Array2<f32>| {
        let halves = values.mapv(f16::from_f32);
        let builder = file.new_dataset_builder().with_data(&halves);
        builder.create(name).unwrap();
    };
    let (_folder, path) = file(plain);
    let expected = batch(&read(&path, None, RewardRule::AsIs));
    for (_folder, path) in [file(half), file(lzf)] {
        assert_eq!(batch(&read(&path, None, RewardRule::AsIs)), expected);
    }
}

#[test]
fn an_unknown_filter_is_named_with_what_rewrites_the_file() {
    let (_folder, path) = file(lzf);
    // The filter's number is eight bytes before its name.
    let mut bytes = fs::read(&path).unwrap();
    let is_name = |i: &usize| bytes[*i..].starts_with(b"lzf\0");
    let places = Vec::from_iter((8..bytes.len() - 4).filter(is_name));
    assert_eq!(places.len(), 4);
    for (number, name) in [(32015_u16, "zstd"), (31999, "number 31999")] {
        for place in &places {
            bytes[place - 8..place - 6].copy_from_slice(&number.to_le_bytes());
        }
        fs::write(&path, &bytes).unwrap();
        let filter = format!("HDF5's filter {name}, which this program cannot read");
        let message = format!("array `observations` is compressed by {filter}");
        assert_refused(&path, None, &message, "python -c");
    }
}

#[test]
fn a_newer_librarys_array_is_not_called_damaged() {
    let unknown = "unable to open dataset: bad version number for layout message";
    let problem = ArrayProblem::Unreadable(hdf5::Error::from(unknown));
    let hint = Problem::Array("rewards".to_owned(), problem).hint();
    let start = "a newer HDF5 library wrote it: pip install h5py";
    assert!(hint.starts_with(start), "{hint}");
}

#[test]
fn arrays_that_lie_elsewhere() {
    let virtually = |file: &hdf5::File, name: &str, values: &Array2<f32>| {
        let shape = values.dim();
        let builder = file.new_dataset::<f32>().shape(shape);
        let builder = builder.virtual_map("other.hdf5", name, shape, .., shape, ..);
        builder.create(name).unwrap();
    };
    let link = |file: &hdf5::File, name: &str, _: &Array2<f32>| {
        file.link_external("other.hdf5", name, name).unwrap()
    };
    let stolen = |file: &hdf5::File, name: &str, values: &Array2<f32>| {
        let other = Path::new(&file.filename()).with_file_name("other.hdf5");
        plain(&hdf5::File::append(&other).unwrap(), name, values);
        link(file, name, values);
    };
    let (_folder, secret) = scratch("secret");
    fs::write(&secret, [7; 4 * ROWS * 3]).unwrap();
    let external = |file: &hdf5::File, name: &str, values: &Array2<f32>| {
        let builder = file.new_dataset::<f32>().shape(values.dim());
        let builder = builder.external(secret.to_str().unwrap(), 0, 4 * values.len());
        builder.create(name).unwrap();
    };
    for (_folder, path) in [file(virtually), file(link), file(stolen), file(external)] {
        let message =
            "array `observations` is not in this file: it leads to numbers that lie elsewhere";
        assert_refused(&path, None, message, "python -c");
    }
}

#[test]
fn a_file_whose_writer_never_closed_it() {
    let (folder, path) = scratch("log.hdf5");
    let mut options = hdf5::File::with_options();
    let options = options.with_fapl(|access| access.libver_latest());
    let file = options.create(&path).unwrap();
    plain(&file, "observations", &Array2::zeros((ROWS, 3)));
    file.flush().unwrap();
    // State on disk while the writer is open.
    let copy = folder.path().join("copy.hdf5");
    fs::copy(&path, &copy).unwrap();
    let message = "not closed by the program that wrote it";
    assert_refused(&copy, None, message, "h5clear");
    drop(file);
}

fn write_archive(path: &Path, masks: Option<[u32; 8]>) {
    type Archive = ZipWriter<fs::File>;
    fn put<T: npyz::AutoSerialize>(archive: &mut Archive, name: &str, values: Vec<T>) {
        let mut bytes = Vec::new();
        let array = npyz::WriteOptions::new().default_dtype().shape(&[8]);
        let mut array = array.writer(&mut bytes).begin_nd().unwrap();
        array.extend(values).unwrap();
        array.finish().unwrap();
        let options = SimpleFileOptions::default();
        archive.start_file(format!("{name}.npy"), options).unwrap();
        archive.write_all(&bytes).unwrap();
    }
    let mut archive = ZipWriter::new(fs::File::create(path).unwrap());
    let quarters = (0..8).map(|i| f16::from_f32(i as f32 / 4.0));
    put(&mut archive, "observations", quarters.collect());
    put(&mut archive, "actions", vec![f16::from_f32(0.5); 8]);
    put(&mut archive, "rewards", (0..8i16).map(|i| -3 * i).collect());
    put(&mut archive, "terminals", vec![0u16, 0, 0, 0, 0, 0, 0, 1]);
    if let Some(masks) = masks {
        put(&mut archive, "masks", masks.to_vec());
    }
    put(&mut archive, "valids", vec![1u64, 1, 1, 1, 1, 1, 1, 0]);
    archive.finish().unwrap();
}

#[test]
fn an_archive_of_short_numbers_is_read() {
    let (_folder, path) = scratch("log.npz");
    let problems_with = |masks| {
        write_archive(&path, masks);
        inspect(&[&path], None).unwrap().problems
    };
    let lacks_masks = |problems: Vec<String>| problems.concat().contains("no array `masks`");
    assert!(lacks_masks(problems_with(None)) && !lacks_masks(problems_with(Some([1; 8]))));
    let batch = batch(&read(&path, None, RewardRule::AsIs));
    let quarters = [0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75];
    assert_eq!(batch.next_observations, quarters);
    assert_eq!(batch.rewards, [0.0, -3.0, -6.0, -9.0, -12.0, -15.0, -18.0]);
    // A trajectory that ends where nothing more is to be gained is not truncated.
    for (last, terminals, timeouts) in [(0, 1.0 / 7.0, 0.0), (1, 0.0, 1.0 / 7.0)] {
        write_archive(&path, Some([1, 1, 1, 1, 1, 1, last, last]));
        let inspection = inspect(&[&path], None).unwrap();
        assert_eq!(inspection.terminals, terminals);
        assert_eq!(inspection.timeouts, timeouts);
    }
}
