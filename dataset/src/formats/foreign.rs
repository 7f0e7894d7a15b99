//! Names of foreign formats, and the tools that read them.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::Path;

use serde_json::Value;

use crate::error::Load::{self, Convert, Get, Python};
use crate::error::Problem;

/// Number of leading bytes that identify a format.
const START: u64 = 256;

const TABLE: Load = Convert(
    "quad-convert FILE --observations COLUMN … --actions COLUMN … --reward COLUMN --episode COLUMN --terminal COLUMN",
);
const ARROW: Load = Python("load it by pandas.read_feather");
const JSON: Load = Python("load it by json.load or pandas.read_json");
const NUMPY: Load = Python("load it by numpy.load");
const MATLAB: Load = Python(
    "load it by scipy.io.loadmat or, if it is of version 7.3, by h5py, which transposes arrays",
);
const PICKLE: Load =
    Python("load it by pickle.load, if you trust who wrote it: a pickle can run any program");
const GZIP: Load = Get("unpack it by gunzip");
const LFS: Load = Get("`git lfs pull` fetches the file");
const SQLITE: &str = "a SQLite database, as ROS 2's bags (.db3) are";
const ROS: Load = Python(
    "load it by the library rosbags, and take of all topics what was the latest at each command",
);

/// First bytes of a file, name of its format, and remedy.
const STARTS: [(&[u8], &str, Load); 13] = [
    (b"PAR1", "a Parquet file", TABLE),
    (b"ARROW1", "an Arrow file", ARROW),
    (b"\x80\x02", "a Python pickle", PICKLE),
    (b"\x80\x03", "a Python pickle", PICKLE),
    (b"\x80\x04", "a Python pickle", PICKLE),
    (b"\x80\x05", "a Python pickle", PICKLE),
    (b"\x93NUMPY", "a single NumPy array", NUMPY),
    (b"MATLAB", "a MATLAB file", MATLAB),
    (b"#ROSBAG", "a ROS bag", ROS),
    (b"\x89MCAP", "an MCAP file, as ROS 2 records them", ROS),
    (b"SQLite format 3", SQLITE, ROS),
    (b"\x1f\x8b", "a file compressed by gzip", GZIP),
    (b"version https://git-lfs", "a pointer of Git LFS", LFS),
];

/// A file in a folder, name of the folder's format, and remedy.
const FOLDERS: [(&str, &str, Load); 4] = [
    (".zgroup", "a Zarr store", ZARR),
    ("zarr.json", "a Zarr store", ZARR),
    ("features.json", RLDS, TENSORFLOW),
    ("metadata.yaml", "a ROS 2 bag", ROS),
];

const RLDS: &str = "a dataset of TensorFlow, as RLDS's are";
const ZARR: Load = Python("load it by zarr.open");
const TENSORFLOW: Load = Python("load it by tensorflow_datasets.builder_from_directory");

fn foreign(what: impl Into<String>, load: Load) -> Problem {
    Problem::Foreign(what.into(), load)
}

/// A file and its first [`START`] bytes.
pub(crate) fn start_of(path: &Path) -> io::Result<(File, Vec<u8>)> {
    let (file, mut start) = (File::open(path)?, Vec::new());
    (&file).take(START).read_to_end(&mut start)?;
    Ok((file, start))
}

/// The problem with a file that is neither HDF5 nor zip, by its first [`START`] bytes.
pub(crate) fn from_start(start: &[u8]) -> Problem {
    if let Some((_, what, load)) = STARTS.iter().find(|(bytes, _, _)| start.starts_with(bytes)) {
        return foreign(*what, *load);
    }
    let mut chunks = start.utf8_chunks();
    let chunk = chunks.next().map_or("", |chunk| chunk.valid());
    // The last character may be cut off.
    let text = if start.len() - chunk.len() < 4 { chunk } else { "" };
    let first_line = text.lines().next().unwrap_or_default();
    if text.contains(|c: char| c.is_control() && !c.is_whitespace()) {
        return Problem::UnknownFormat;
    }
    match text.starts_with(['{', '[']) {
        true => foreign("a JSON file", JSON),
        false if text.trim_start().starts_with('<') => {
            foreign("a web page, or other XML", Get("download the file by its own link"))
        }
        false if first_line.contains([',', ';', '\t']) => foreign("a table as text (CSV)", TABLE),
        false => Problem::UnknownFormat,
    }
}

pub(crate) fn from_folder(folder: &Path) -> Problem {
    let text = |file: &str, key: &str| {
        let json: Value = serde_json::from_slice(&fs::read(folder.join(file)).ok()?).ok()?;
        json[key].as_str().map(str::to_owned)
    };
    if let Some(version) = text("meta/info.json", "codebase_version") {
        let load = Convert(
            "quad-convert FOLDER --observations observation.state --reward step-cost --success EPISODE …",
        );
        return foreign(format!("a LeRobot dataset of version {version}"), load);
    }
    let format = |file| text(file, "data_format").filter(|format| format != "hdf5");
    let Some(format) = format("data/metadata.json").or_else(|| format("metadata.json")) else {
        let format = FOLDERS.iter().find(|(file, _, _)| folder.join(file).exists());
        return format.map_or(Problem::UnknownFolder, |(_, what, load)| foreign(*what, *load));
    };
    let load = Convert("quad-convert FOLDER");
    foreign(format!("a Minari dataset stored as {format}"), load)
}

/// The problem with an HDF5 file of robomimic's layout.
pub(crate) fn robomimic(has_rewards: bool) -> Problem {
    match has_rewards {
        true => foreign("a robomimic file", Convert("quad-convert FILE --observations KEY …")),
        false => foreign(
            "a file in robomimic's layout without rewards, as Isaac Lab's recorder writes it",
            Convert("quad-convert FILE --observations KEY … --reward success-at-end --success all"),
        ),
    }
}

/// The problem with a zip archive of these files, if they are not OGBench's.
pub(crate) fn from_archive(files: &[impl AsRef<str>]) -> Option<Problem> {
    let has = |ending: &str| files.iter().any(|name| name.as_ref().ends_with(ending));
    if has("timeouts.npy") {
        // In OGBench's layout all ends are `terminals`, and those of the task are in `masks`.
        return Some(foreign("an npz archive with `timeouts`, which OGBench's have not", NUMPY));
    }
    if has(".npy") {
        return None;
    }
    Some(match has("data.pkl") {
        true => foreign("a PyTorch file", Python("load it by torch.load")),
        false => Problem::UnknownFormat,
    })
}
