//! Errors of reading and writing datasets. Messages name the file and, if possible, array and row.

use std::error::Error;
use std::io;
use std::path::PathBuf;

/// Failure to read, accept or write a dataset.
#[derive(Debug, thiserror::Error)]
#[error("{}: {problem}", .path.display())]
pub struct DatasetError {
    /// File or folder.
    pub path: PathBuf,
    /// Problem found in it.
    #[source]
    pub problem: Problem,
}

impl DatasetError {
    pub(crate) fn new(path: impl Into<PathBuf>, problem: Problem) -> Self {
        Self { path: path.into(), problem }
    }

    /// Advice on how to fix it.
    pub fn hint(&self) -> String {
        self.problem.hint()
    }
}

/// Problem with a dataset. Arrays are named by their path in the file; rows count from 0.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each is.
pub enum Problem {
    #[error("cannot be opened or written")]
    Io(#[source] io::Error),
    #[error("neither an HDF5 file nor an npz archive")]
    UnknownFormat,
    #[error("a folder without main_data.hdf5, so no Minari dataset that is stored as HDF5")]
    UnknownFolder,
    #[error("{what}, which is none of the formats that are read")]
    Foreign { what: String, load: Load },
    #[error("locked: another program has it open for writing, or its file system has no locks")]
    Locked(#[source] hdf5::Error),
    #[error("not closed by the program that wrote it")]
    NotClosed(#[source] hdf5::Error),
    #[error("cut short: {bytes} bytes are there of {expected}")]
    Truncated { bytes: u64, expected: u64 },
    #[error("not an HDF5 file, or a damaged or incomplete one")]
    DamagedHdf5(#[source] hdf5::Error),
    #[error("a damaged or incomplete npz archive")]
    DamagedNpz(#[source] zip::result::ZipError),
    #[error("cannot be understood")]
    Metadata(#[source] serde_json::Error),
    #[error(
        "the attribute `layout` is {found:?}, but the only value with a meaning is \"transitions\""
    )]
    UnknownLayout { found: String },
    #[error("the attribute `{attribute}` has {found} texts, but a row has {expected} numbers")]
    Names { attribute: String, found: usize, expected: usize },
    #[error("array `{array}` is missing")]
    Missing { array: String },
    #[error("array `{array}` holds {found}, but must hold {expected}")]
    Type { array: String, found: String, expected: &'static str },
    #[error(
        "array `{array}` has shape {found:?}, but must have one or two axes: rows, and the numbers in each"
    )]
    Axes { array: String, found: Vec<usize> },
    #[error("array `{array}` has shape {found:?}, but must have {expected:?}")]
    Shape { array: String, found: Vec<usize>, expected: Vec<usize> },
    #[error("array `{array}` has {found} numbers, but {rows} rows of {width} are {}", .rows * .width)]
    Numbers { array: String, found: usize, rows: usize, width: usize },
    #[error(
        "array `{array}` claims the shape {found:?}, more than a file of {bytes} bytes can hold"
    )]
    Oversized { array: String, found: Vec<usize>, bytes: u64 },
    #[error(
        "array `{array}` is compressed by HDF5's filter {filter}, which this program cannot read"
    )]
    Filter { array: String, filter: String },
    #[error("array `{array}` is not in this file: it leads to numbers that lie elsewhere")]
    Elsewhere { array: String },
    #[error("array `{array}` cannot be read")]
    Unreadable {
        array: String,
        #[source]
        source: Box<dyn Error + Send + Sync>,
    },
    #[error("{found} episodes, but metadata.json says {expected}")]
    Episodes { found: usize, expected: usize },
    #[error("`{array}` is a group of arrays, but must be an array")]
    Group { array: String },
    #[error("recorded in `{claimed}`, which is not `{expected}`")]
    OtherEnvironment { claimed: String, expected: String, is_simulated: bool },
    #[error("recorded in `OGBench`, which is not `{expected}`")]
    OtherMaze { expected: String },
    #[error("`{array}` has {found} numbers a row, but `{environment}` has {expected}")]
    Width { array: &'static str, found: usize, expected: usize, environment: String },
    #[error("array `{array}`, row {row}: {value} is not a finite float32{}", such_rows(*.rows))]
    NotFinite { array: String, row: usize, value: f32, rows: usize },
    #[error("array `{array}`, row {row}: {value} is neither 0 nor 1")]
    NotBoolean { array: String, row: usize, value: f32 },
    #[error("array `{array}`, row {row}: the action {value} is outside [-1, 1]{}", such_rows(*.rows))]
    ActionOutside { array: String, row: usize, value: f32, rows: usize },
    #[error(
        "array `{array}` holds whole numbers, as if actions were discrete; only continuous ones can be learned"
    )]
    DiscreteActions { array: String },
    #[error(
        "array `next_observations`, row {row}: not the observation of the row that follows, though the episode continues there{}",
        such_rows(*.rows)
    )]
    Stray { row: usize, rows: usize },
    #[error("{rows} rows without any terminal or timeout, as if they were one endless episode")]
    Endless { rows: usize },
    #[error("{rows} rows, of which none makes a transition")]
    NoTransitions { rows: usize },
    #[error(
        "all trajectories have the same return, so the reward rule `locomotion` cannot scale them"
    )]
    SameReturns,
    #[error("cannot be written")]
    Write(#[source] hdf5::Error),
    #[error("row {row} cannot be written: `{array}` {problem}")]
    BadRow { row: usize, array: &'static str, problem: String },
}

/// Remedy for a foreign format.
#[derive(Clone, Copy, Debug)]
pub enum Load {
    /// Command of `quad-convert`, without its `--out`.
    Convert(&'static str),
    /// Advice on loading it in Python.
    Python(&'static str),
}

pub(crate) fn such_rows(rows: usize) -> String {
    if rows > 1 { format!(" ({rows} such rows)") } else { String::new() }
}

impl Problem {
    /// Advice on how to fix it.
    pub fn hint(&self) -> String {
        if let Self::OtherEnvironment { claimed, expected, is_simulated } = self {
            return match is_simulated {
                true => format!("choose a task in {claimed}, or another dataset"),
                false => format!(
                    "it is another simulation, so a policy that learns from it cannot be scored in {expected}; train under a name of \
                     your own, without evaluations: --task own-data --env NAME"
                ),
            };
        }
        if let Self::Foreign { load, .. } = self {
            return match load {
                Load::Convert(command) => format!(
                    "with quad_rl installed, `{command} --out my-robot.hdf5` makes a file that is read (docs/data.md)"
                ),
                Load::Python(advice) => format!(
                    "{advice}; then write its numbers to an HDF5 file of your own by the ten lines of h5py in docs/data.md"
                ),
            };
        }
        self.advice().to_owned()
    }

    fn advice(&self) -> &'static str {
        match self {
            Self::OtherEnvironment { .. } | Self::Foreign { .. } => "",
            Self::OtherMaze { .. } => {
                "choose one of its own tasks, such as antmaze-large-navigate-singletask-task1-v0, or another dataset"
            }
            Self::Width { .. } => {
                "choose a dataset of that environment, or a task in the environment it was recorded in"
            }
            Self::Io(_) => "check the path and its permissions",
            Self::UnknownFormat => {
                "a dataset is a D4RL file (.hdf5), a folder of Minari, an OGBench file (.npz), or your own HDF5 file as docs/data.md describes"
            }
            Self::UnknownFolder => {
                "give the folder of one Minari dataset, like ~/.minari/datasets/mujoco/hopper/medium-v0"
            }
            Self::Truncated { .. } | Self::DamagedHdf5(_) | Self::DamagedNpz(_) => {
                "the file was cut off or damaged on its way: fetch or copy it again; the program that writes one of your own must close it"
            }
            Self::Locked(_) => {
                "close it in that program; if none has it open, set HDF5_USE_FILE_LOCKING=FALSE and try again"
            }
            Self::NotClosed(_) => {
                "let that program close it; if the program is gone, `h5clear --status FILE` (of HDF5's tools) frees what it wrote"
            }
            Self::Filter { .. } | Self::Elsewhere { .. } => REWRITE,
            Self::Unreadable { .. } => "the file is damaged: fetch or copy it again",
            Self::Oversized { .. } => {
                "the file is damaged, or most of these rows were never written: fetch or copy it again, or write only the rows that there are"
            }
            Self::Metadata(_) => {
                "fetch the Minari dataset again; metadata.json is what Minari writes beside the data"
            }
            Self::UnknownLayout { .. } | Self::Names { .. } => {
                "see docs/data.md for what the attribute means"
            }
            Self::Missing { array } if array == "rewards" => {
                "learning needs a reward for each step; a task such as antmaze-large-navigate-singletask-task1-v0 has those of OGBench's mazes, and with quad_rl installed, `quad-convert ogbench:NAME --out FILE` adds others"
            }
            Self::Missing { .. } => "docs/data.md says which arrays each kind of file must have",
            Self::Numbers { .. } => {
                "all arrays need the same number of rows, which is that of `rewards`"
            }
            Self::NotBoolean { .. } => {
                "a flag is 0 or 1: of a discount, write 1 where it is 0, and else 0 (docs/data.md says what each flag means)"
            }
            Self::Type { .. } | Self::Axes { .. } | Self::Shape { .. } => {
                "docs/data.md says which shape and type each array must have; all arrays need the same number of rows"
            }
            Self::Episodes { .. } => "the dataset is incomplete: fetch it again",
            Self::NotFinite { .. } => {
                "leave out or repair these rows: a single one would spoil every weight"
            }
            Self::ActionOutside { .. } => {
                "`learner train --normalize actions` trains on them: it maps the least and the largest of each number to ±1, and the policy's actions back"
            }
            Self::Group { .. } => {
                "an observation may be an array or a Dict of arrays, but not a Dict of Dicts: with quad_rl installed, `quad-convert FOLDER --out my-robot.hdf5` makes one row of it"
            }
            Self::DiscreteActions { .. } => {
                "store continuous actions as float32; where they leave [-1, 1], `learner train --normalize actions` scales them"
            }
            Self::Stray { .. } => {
                "keep the rows in the order of recording and mark where episodes end in `terminals` and `timeouts`; for rows in any other order set the attribute `layout` as docs/data.md describes"
            }
            Self::Endless { .. } => {
                "set `timeouts` to 1 at the last row of each episode that did not terminate"
            }
            Self::NoTransitions { .. } => {
                "record more: a transition needs a row and the one that follows it"
            }
            Self::SameReturns => {
                "unless all rewards are alike, another reward rule learns from them: --set reward=as-is"
            }
            Self::Write(_) => "check that the disk has room and the folder is writable",
            Self::BadRow { .. } => "each row must have the environment's sizes and finite numbers",
        }
    }
}

const REWRITE: &str = "pip install h5py hdf5plugin; then write it again, with your names for OLD and NEW: python -c \"import h5py, \
    hdf5plugin; a, b = h5py.File('OLD'), h5py.File('NEW', 'w'); b.attrs.update(a.attrs); a.visititems(lambda name, x: \
    b.update({name: x[()]}) if isinstance(x, h5py.Dataset) else None)\"";
