use std::fs;
use std::path::{Path, PathBuf};

use hdf5::H5Type;
use hdf5::types::FixedAscii;
use ndarray::ArrayViewD;
use quad_dataset::{
    DatasetError, Normalize, Problem, ReadOptions, RecordedRows, RewardRule, Transitions,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tempfile::{TempDir, tempdir};

use crate::{hopper, put, try_read};

const ROWS: usize = 20;

struct Subject {
    folder: TempDir,
}

impl Subject {
    fn new() -> Self {
        let this = Self { folder: tempdir().unwrap() };
        let file = hdf5::File::create(this.path()).unwrap();
        put(&file, "observations", &[ROWS, 11], &[0.5f32; ROWS * 11]);
        put(&file, "actions", &[ROWS, 3], &[0.5f32; ROWS * 3]);
        put(&file, "rewards", &[ROWS], &[1.0f32; ROWS]);
        put(&file, "terminals", &[ROWS], &std::array::from_fn::<_, ROWS, _>(|i| i == 4));
        put(&file, "timeouts", &[ROWS], &[false; ROWS]);
        this
    }

    fn path(&self) -> PathBuf {
        self.folder.path().join("subject.hdf5")
    }

    fn replace<T: H5Type>(&self, array: &str, shape: &[usize], data: &[T]) {
        let file = hdf5::File::open_rw(self.path()).unwrap();
        file.unlink(array).unwrap();
        put(&file, array, shape, data);
    }

    fn read(&self) -> Result<Transitions, DatasetError> {
        try_read(&self.path(), Some(hopper()))
    }

    /// Text of the error after the file's path.
    fn error(&self) -> String {
        let error = self.read().err().expect("the file is broken");
        let text = error.to_string();
        let path = format!("{}: ", self.path().display());
        text.strip_prefix(&path)
            .unwrap_or_else(|| panic!("{text} does not start with {path}"))
            .to_owned()
    }
}

#[test]
fn a_missing_file() {
    let error = try_read(Path::new("/nowhere/x.hdf5"), Some(hopper())).err().unwrap();
    assert!(matches!(error.problem, Problem::Io(_)) && error.path == Path::new("/nowhere/x.hdf5"));
}

#[test]
fn not_hdf5_at_all() {
    let subject = Subject::new();
    let mut noise = vec![0; 5000];
    ChaCha8Rng::seed_from_u64(1).fill(&mut noise[..]);
    for content in [&noise[..], b""] {
        fs::write(subject.path(), content).unwrap();
        assert_eq!(subject.error(), "neither an HDF5 file nor an npz archive");
    }
    fs::write(subject.path(), b"\x89HDF\r\n\x1a\n").unwrap();
    assert_eq!(subject.error(), "not an HDF5 file, or a damaged or incomplete one");
}

#[test]
fn truncated_anywhere() {
    let subject = Subject::new();
    let whole = fs::read(subject.path()).unwrap();
    for length in (97..whole.len()).step_by(97) {
        fs::write(subject.path(), &whole[..length]).unwrap();
        assert_eq!(
            subject.error(),
            format!("cut short: {length} bytes are there of {}", whole.len())
        );
    }
}

#[test]
fn damaged_inside_a_compressed_array() {
    let subject = Subject::new();
    let mut generator = ChaCha8Rng::seed_from_u64(2);
    let noise: Vec<f32> = (0..ROWS * 3).map(|_| generator.random()).collect();
    let file = hdf5::File::open_rw(subject.path()).unwrap();
    file.unlink("actions").unwrap();
    let array = file
        .new_dataset::<f32>()
        .chunk((ROWS, 3))
        .deflate(4)
        .shape((ROWS, 3))
        .create("actions")
        .unwrap();
    array.write(ArrayViewD::from_shape([ROWS, 3].as_slice(), &noise).unwrap()).unwrap();
    file.flush().unwrap();
    let chunk = array.chunk_info(0).unwrap();
    drop((array, file));
    subject.read().unwrap();

    let mut bytes = fs::read(subject.path()).unwrap();
    let stored = chunk.addr as usize..(chunk.addr + chunk.size) as usize;
    bytes[stored].reverse();
    fs::write(subject.path(), bytes).unwrap();
    assert_eq!(subject.error(), "array `actions` cannot be read");
}

#[test]
fn a_missing_array() {
    for array in ["observations", "actions", "rewards", "terminals"] {
        let subject = Subject::new();
        hdf5::File::open_rw(subject.path()).unwrap().unlink(array).unwrap();
        assert_eq!(subject.error(), format!("array `{array}` is missing"));
    }
    let error = RecordedRows::read(Subject::new().path(), hopper()).err().unwrap();
    assert!(error.to_string().ends_with("array `infos/qpos` is missing"), "{error}");
}

#[test]
fn an_array_that_is_not_what_it_must_be() {
    let text: FixedAscii<4> = FixedAscii::from_ascii(b"true").unwrap();
    let (half, mut unknown, mut large) = ([0.5f32; ROWS * 17], [0.5f32; ROWS * 11], [0.5f64; ROWS]);
    unknown[7 * 11 + 3] = f32::NAN;
    unknown[8 * 11..9 * 11].fill(f32::INFINITY);
    large[19] = 1e39;
    let flag = |value: i32| {
        let mut flags = [0; ROWS];
        flags[3] = value;
        flags
    };
    type Spoil<'a> = &'a dyn Fn(&Subject);
    let cases: [(&str, Spoil<'_>); 14] = [
        ("`observations` has 17 numbers a row, but `hopper` has 11", &|file| {
            file.replace("observations", &[ROWS, 17], &half);
        }),
        ("`actions` has 6 numbers a row, but `hopper` has 3", &|file| {
            file.replace("actions", &[ROWS, 6], &half[..ROWS * 6]);
        }),
        ("array `rewards` has shape [19], but must have [20, 1]", &|file| {
            file.replace("rewards", &[ROWS - 1], &half[..ROWS - 1]);
        }),
        ("array `terminals` has shape [20, 2], but must have [20, 1]", &|file| {
            file.replace("terminals", &[ROWS, 2], &[false; ROWS * 2]);
        }),
        ("array `observations`, row 7: NaN is not a finite float32 (2 such rows)", &|file| {
            file.replace("observations", &[ROWS, 11], &unknown);
        }),
        ("array `rewards`, row 19: inf is not a finite float32", &|file| {
            file.replace("rewards", &[ROWS], &large)
        }),
        ("array `actions` holds bool, but must hold numbers", &|file| {
            file.replace("actions", &[ROWS, 3], &[false; ROWS * 3]);
        }),
        ("but must hold booleans (h5py's enum, or numbers that are 0 or 1)", &|file| {
            file.replace("terminals", &[ROWS], &[text; ROWS]);
        }),
        ("must have one or two axes: rows, and the numbers in each", &|file| {
            file.replace("observations", &[ROWS, 1, 11], &half[..ROWS * 11]);
        }),
        ("array `timeouts`, row 3: 2 is neither 0 nor 1", &|file| {
            file.replace("timeouts", &[ROWS], &flag(2))
        }),
        ("array `timeouts`, row 3: -1 is neither 0 nor 1", &|file| {
            file.replace("timeouts", &[ROWS], &flag(-1))
        }),
        ("array `timeouts`, row 3: 127 is neither 0 nor 1", &|file| {
            file.replace("timeouts", &[ROWS], &flag(256))
        }),
        ("20 rows, of which none makes a transition", &|file| {
            file.replace("timeouts", &[ROWS], &[true; ROWS])
        }),
        ("`rewards` is a group of arrays, but must be an array", &|subject| {
            let file = hdf5::File::open_rw(subject.path()).unwrap();
            file.unlink("rewards").unwrap();
            file.create_group("rewards").unwrap();
        }),
    ];
    for (expected, spoil) in cases {
        let subject = Subject::new();
        assert_eq!(subject.read().unwrap().len(), ROWS - 1, "the subject itself is whole");
        spoil(&subject);
        assert!(subject.error().ends_with(expected), "{}, not {expected}", subject.error());
    }
}

#[test]
fn actions_outside_the_unit_box() {
    let mut data = [1.0f32; ROWS * 3];
    data[4] = 1.0009; // rounding
    let subject = Subject::new();
    subject.replace("actions", &[ROWS, 3], &data);
    assert!(subject.read().is_ok());
    data[16..20].fill(-30.0);
    subject.replace("actions", &[ROWS, 3], &data);
    assert_eq!(
        subject.error(),
        "array `actions`, row 5: the action -30 is outside [-1, 1] (2 such rows)"
    );
}

#[test]
fn an_endless_episode() {
    let long = |rows: usize| {
        let subject = Subject::new();
        subject.replace("observations", &[rows, 11], &vec![0.5f32; rows * 11]);
        subject.replace("actions", &[rows, 3], &vec![0.5f32; rows * 3]);
        subject.replace("rewards", &[rows], &vec![0.5f32; rows]);
        subject.replace("terminals", &[rows], &vec![false; rows]);
        subject.replace("timeouts", &[rows], &vec![false; rows]);
        subject
    };
    assert!(long(1000).read().is_ok(), "a single episode of as many steps as Hopper allows");
    let subject = long(1001);
    assert_eq!(
        subject.error(),
        "1001 rows without any terminal or timeout, as if they were one endless episode"
    );
    assert!(try_read(&long(50).path(), None).is_err());
    // Without `timeouts`, Hopper's time limit truncates.
    hdf5::File::open_rw(subject.path()).unwrap().unlink("timeouts").unwrap();
    assert!(subject.read().is_ok());
}

#[test]
fn a_size_that_no_such_file_can_hold() {
    let subject = Subject::new();
    let file = hdf5::File::open_rw(subject.path()).unwrap();
    file.unlink("observations").unwrap();
    let shape = (1usize << 50, 11);
    file.new_dataset::<f32>().chunk((1024, 11)).shape(shape).create("observations").unwrap();
    drop(file);
    let bytes = fs::metadata(subject.path()).unwrap().len();
    let shape = [1usize << 50, 11];
    assert_eq!(
        subject.error(),
        format!(
            "array `observations` claims the shape {shape:?}, more than a file of {bytes} bytes can hold"
        )
    );
}

#[test]
fn returns_without_any_spread() {
    let subject = Subject::new();
    subject.replace("rewards", &[ROWS], &[0f32; ROWS]);
    assert!(subject.read().is_ok());
    let options = ReadOptions {
        environment: Some(hopper()),
        task: None,
        reward: RewardRule::Locomotion,
        normalize: Normalize::default(),
    };
    let error = Transitions::read(subject.path(), &options).err().unwrap();
    assert!(matches!(error.problem, Problem::SameReturns), "{error}");
}
