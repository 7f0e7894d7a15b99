use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use ndarray::Array2;
use npyz::WriterBuilder;
use npyz::half::f16;
use quad_dataset::{DatasetError, Problem, RewardRule, data_file, inspect};
use tempfile::{TempDir, tempdir};
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

use crate::{all, read};

const ROWS: usize = 300;

fn error(path: &Path) -> DatasetError {
    inspect(path, None).err().unwrap()
}

fn foreign(path: &Path) -> String {
    let error = error(path);
    assert!(error.hint().contains("docs/data.md"), "{}", error.hint());
    let Problem::Foreign { what, .. } = error.problem else { panic!("{error}") };
    what
}

#[test]
fn files_of_other_formats_are_named() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("log");
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
    ] {
        fs::write(&path, content).unwrap();
        assert_eq!(foreign(&path), what);
    }
    for content in [&b"nothing that is known\n"[..], b"\0,\0,", b"\xff\xfe,,"] {
        fs::write(&path, content).unwrap();
        assert!(matches!(error(&path).problem, Problem::UnknownFormat), "{content:?}");
    }
}

#[test]
fn folders_of_other_formats_are_named() {
    for (file, content, what) in [
        ("meta/info.json", r#"{"codebase_version": "v3.0"}"#, "a LeRobot dataset of version v3.0"),
        ("meta/info.json", r#"{"codebase_version": "v2.1"}"#, "a LeRobot dataset of version v2.1"),
        ("data/metadata.json", r#"{"data_format": "arrow"}"#, "a Minari dataset stored as arrow"),
        ("metadata.json", r#"{"data_format": "parquet"}"#, "a Minari dataset stored as parquet"),
    ] {
        let folder = tempdir().unwrap();
        let path = folder.path().join(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
        assert_eq!(foreign(folder.path()), what);
        assert!(matches!(data_file(folder.path()).unwrap_err().problem, Problem::Foreign { .. }));
    }
    let empty = tempdir().unwrap();
    assert!(matches!(error(empty.path()).problem, Problem::UnknownFolder));
}

#[test]
fn archives_without_arrays_are_named() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("archive");
    let zip = |name: &str| {
        let mut archive = ZipWriter::new(fs::File::create(&path).unwrap());
        archive.start_file(name, SimpleFileOptions::default()).unwrap();
        archive.finish().unwrap();
    };
    zip("policy/data.pkl");
    assert_eq!(foreign(&path), "a PyTorch file");
    zip("readme.txt");
    assert!(matches!(error(&path).problem, Problem::UnknownFormat));
}

#[test]
fn a_robomimic_file_is_named() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("low_dim.hdf5");
    let demonstration = |rewards: bool| {
        let group = hdf5::File::create(&path)
            .unwrap()
            .create_group("data")
            .unwrap()
            .create_group("demo_0")
            .unwrap();
        for array in
            ["actions", "rewards"].into_iter().filter(|array| rewards || *array == "actions")
        {
            group.new_dataset::<f32>().shape(3).create(array).unwrap();
        }
    };
    demonstration(true);
    assert_eq!(foreign(&path), "a robomimic file");
    demonstration(false);
    assert_eq!(
        foreign(&path),
        "a file in robomimic's layout without rewards, as Isaac Lab's recorder writes it"
    );
    let hint = error(&path).hint();
    assert!(
        hint.contains(
            "quad-convert FILE --observations KEY … --reward success-at-end --success all"
        ),
        "{hint}"
    );
}

fn file(write: impl Fn(&hdf5::File, &str, Array2<f32>)) -> (TempDir, PathBuf) {
    let folder = tempdir().unwrap();
    let path = folder.path().join("log.hdf5");
    let file = hdf5::File::create(&path).unwrap();
    for (name, width) in [("observations", 3), ("actions", 2), ("rewards", 1), ("terminals", 1)] {
        // Multiples of 1/4 are exact in half precision.
        let value = |(i, j): (usize, usize)| {
            if name == "terminals" { u8::from(i == 7).into() } else { ((i + j) % 4) as f32 / 4.0 }
        };
        write(&file, name, Array2::from_shape_fn((ROWS, width), value));
    }
    (folder, path)
}

fn plain(file: &hdf5::File, name: &str, values: Array2<f32>) {
    file.new_dataset_builder().with_data(&values).create(name).unwrap();
}

#[test]
fn half_precision_and_lzf_are_read() {
    let half = |file: &hdf5::File, name: &str, values: Array2<f32>| {
        file.new_dataset_builder().with_data(&values.mapv(f16::from_f32)).create(name).unwrap();
    };
    let lzf = |file: &hdf5::File, name: &str, values: Array2<f32>| {
        file.new_dataset_builder()
            .with_data(&values)
            .chunk((100, values.ncols()))
            .shuffle()
            .lzf()
            .create(name)
            .unwrap();
    };
    let (_folder, path) = file(plain);
    let expected = all(&read(&path, None, RewardRule::AsIs));
    for (_folder, path) in [file(half), file(lzf)] {
        assert_eq!(all(&read(&path, None, RewardRule::AsIs)), expected);
    }
}

#[test]
fn an_unknown_filter_is_named_with_what_rewrites_the_file() {
    let (_folder, path) = file(|file, name, values| {
        file.new_dataset_builder()
            .with_data(&values)
            .chunk((100, values.ncols()))
            .lzf()
            .create(name)
            .unwrap();
    });
    // The filter's number is eight bytes before its name.
    let mut bytes = fs::read(&path).unwrap();
    let places: Vec<usize> =
        (8..bytes.len() - 4).filter(|&i| bytes[i..].starts_with(b"lzf\0")).collect();
    assert_eq!(places.len(), 4);
    for (number, name) in [(32015_u16, "zstd"), (31999, "number 31999")] {
        places
            .iter()
            .for_each(|place| bytes[place - 8..place - 6].copy_from_slice(&number.to_le_bytes()));
        fs::write(&path, &bytes).unwrap();
        let error = error(&path);
        let expected = format!(
            "array `observations` is compressed by HDF5's filter {name}, which this program cannot read"
        );
        assert!(error.to_string().ends_with(&expected), "{error}");
        assert!(error.hint().contains("python -c"), "{}", error.hint());
    }
}

#[test]
fn arrays_that_lie_elsewhere() {
    let virtually = |file: &hdf5::File, name: &str, values: Array2<f32>| {
        let builder = file.new_dataset::<f32>().shape(values.dim());
        builder
            .virtual_map("other.hdf5", name, values.dim(), .., values.dim(), ..)
            .create(name)
            .unwrap();
    };
    let link = |file: &hdf5::File, name: &str, _: Array2<f32>| {
        file.link_external("other.hdf5", name, name).unwrap()
    };
    let stolen = |file: &hdf5::File, name: &str, values: Array2<f32>| {
        let other = Path::new(&file.filename()).with_file_name("other.hdf5");
        plain(&hdf5::File::append(&other).unwrap(), name, values.clone());
        link(file, name, values);
    };
    let folder = tempdir().unwrap();
    let secret = folder.path().join("secret");
    fs::write(&secret, [7; 4 * ROWS * 3]).unwrap();
    let external = |file: &hdf5::File, name: &str, values: Array2<f32>| {
        let builder = file.new_dataset::<f32>().shape(values.dim());
        builder.external(secret.to_str().unwrap(), 0, 4 * values.len()).create(name).unwrap();
    };
    for (_folder, path) in [file(virtually), file(link), file(stolen), file(external)] {
        let error = error(&path);
        assert!(
            matches!(&error.problem, Problem::Elsewhere { array } if array == "observations"),
            "{error}"
        );
    }
}

#[test]
fn a_file_whose_writer_never_closed_it() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("log.hdf5");
    let file = hdf5::File::with_options()
        .with_fapl(|access| access.libver_latest())
        .create(&path)
        .unwrap();
    plain(&file, "observations", Array2::zeros((ROWS, 3)));
    file.flush().unwrap();
    // State on disk while the writer is open.
    let copy = folder.path().join("copy.hdf5");
    fs::copy(&path, &copy).unwrap();
    assert!(matches!(error(&copy).problem, Problem::NotClosed(_)), "{}", error(&copy));
    drop(file);
}

fn write_archive(path: &Path, masks: [u32; 8]) {
    fn put<T: npyz::AutoSerialize>(archive: &mut ZipWriter<fs::File>, name: &str, values: Vec<T>) {
        let mut bytes = Vec::new();
        let mut array = npyz::WriteOptions::new()
            .default_dtype()
            .shape(&[8])
            .writer(&mut bytes)
            .begin_nd()
            .unwrap();
        array.extend(values).unwrap();
        array.finish().unwrap();
        archive.start_file(format!("{name}.npy"), SimpleFileOptions::default()).unwrap();
        archive.write_all(&bytes).unwrap();
    }
    let mut archive = ZipWriter::new(fs::File::create(path).unwrap());
    put(&mut archive, "observations", (0..8).map(|i| f16::from_f32(i as f32 / 4.0)).collect());
    put(&mut archive, "actions", vec![f16::from_f32(0.5); 8]);
    put(&mut archive, "rewards", (0..8).map(|i| -3 * i).collect::<Vec<i16>>());
    put(&mut archive, "terminals", (0..8).map(|i| u16::from(i == 7)).collect());
    put(&mut archive, "masks", masks.to_vec());
    put(&mut archive, "valids", (0..8).map(|i| u64::from(i < 7)).collect());
    archive.finish().unwrap();
}

#[test]
fn an_archive_of_short_numbers_is_read() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("log.npz");
    write_archive(&path, [1; 8]);
    let batch = all(&read(&path, None, RewardRule::AsIs));
    assert_eq!(batch.next_observations, [0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75]);
    assert_eq!(batch.rewards, [0.0, -3.0, -6.0, -9.0, -12.0, -15.0, -18.0]);
}

#[test]
fn a_trajectory_that_ends_where_nothing_more_is_to_be_gained_is_not_cut_off() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("log.npz");
    for (last, terminals, timeouts) in [(0, 1.0 / 7.0, 0.0), (1, 0.0, 1.0 / 7.0)] {
        write_archive(&path, [1, 1, 1, 1, 1, 1, last, last]);
        let inspection = inspect(&path, None).unwrap();
        assert_eq!((inspection.terminals, inspection.timeouts), (terminals, timeouts));
    }
}
