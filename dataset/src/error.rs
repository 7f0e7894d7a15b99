//! Errors of reading and writing datasets. Messages name the file and, if possible, array and row.

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
    pub(crate) fn new(path: impl Into<PathBuf>, problem: impl Into<Problem>) -> Self {
        let (path, problem) = (path.into(), problem.into());
        Self { path, problem }
    }

    /// Advice on how to fix it.
    pub fn hint(&self) -> String {
        self.problem.hint()
    }
}

/// Reason why a dataset cannot be read, trained on or written.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each is.
pub enum Problem {
    #[error("cannot be opened or written")]
    Io(#[from] io::Error),
    #[error("neither an HDF5 file nor an npz archive")]
    UnknownFormat,
    #[error("a folder without Minari's main_data.hdf5")]
    UnknownFolder,
    #[error("{0}, which is none of the formats that are read")]
    Foreign(String, Load),
    #[error("locked: another program has it open for writing, or its file system has no locks")]
    Locked(#[source] hdf5::Error),
    #[error("not closed by the program that wrote it")]
    NotClosed(#[source] hdf5::Error),
    #[error("cut short: {bytes} bytes are there of {expected}")]
    Truncated { bytes: u64, expected: u64 },
    #[error("not an HDF5 file, or a damaged or incomplete one")]
    DamagedHdf5(#[source] hdf5::Error),
    #[error("a damaged or incomplete npz archive")]
    DamagedNpz(#[from] zip::result::ZipError),
    #[error("cannot be understood")]
    Metadata(#[from] serde_json::Error),
    #[error("the attribute `layout` is {0:?}, but may only be \"transitions\"")]
    UnknownLayout(String),
    #[error("the attribute `{0}` has {1} texts for {2} numbers")]
    Names(&'static str, usize, usize),
    #[error("the attribute `{0}` has the name {1:?} for {2}")]
    Name(&'static str, String, String),
    #[error("array `{0}` {1}")]
    Array(String, #[source] ArrayProblem),
    /// Array, first such row, number of such rows, and their problem.
    #[error("array `{0}`, row {1}: {3}{such}", such = such_rows(*.2))]
    Rows(String, usize, usize, RowProblem),
    #[error("{0} episodes, but metadata.json says {1}")]
    Episodes(usize, usize),
    /// The last is true if the recorded environment is simulated here.
    #[error("recorded in `{0}`, which is not `{1}`")]
    OtherEnvironment(String, String, bool),
    #[error("recorded in `OGBench`, which is not `{0}`")]
    OtherMaze(String),
    #[error("`{0}` has {1} numbers a row, but `{2}` has {3}")]
    Width(&'static str, usize, String, usize),
    #[error("{0} rows without a terminal or timeout: one endless episode")]
    Endless(usize),
    #[error("{0} rows, of which none makes a transition")]
    NoTransitions(usize),
    #[error("`locomotion` cannot scale the rewards: no two returns of a dataset differ")]
    SameReturns,
    #[error("does not fit {file} ({1})", file = .0.display())]
    Unlike(PathBuf, String),
    #[error("cannot be written")]
    Write(#[source] hdf5::Error),
}

/// Reason why an array cannot be used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each is.
pub enum ArrayProblem {
    /// With the names of the arrays and groups that are in its place.
    #[error("is missing")]
    Missing(Vec<String>),
    #[error("is a group of arrays, but must be an array")]
    Group,
    #[error("holds {0}, but must hold {1}")]
    Type(String, &'static str),
    #[error("holds whole numbers, but only continuous actions can be learned")]
    DiscreteActions,
    #[error("has shape {0:?}, but must have rows, or rows of numbers")]
    Axes(Vec<usize>),
    #[error("has shape {0:?}, but must have {1} rows")]
    Rows(Vec<usize>, usize),
    #[error("has shape {0:?}, but must have {shape}", shape = shape(*.1))]
    Shape(Vec<usize>, [usize; 2]),
    #[error("claims the shape {0:?}, more than a file of {1} bytes can hold")]
    Oversized(Vec<usize>, u64),
    #[error("is compressed by HDF5's filter {0}, which this program cannot read")]
    Filter(String),
    #[error("is not in this file: it leads to numbers that lie elsewhere")]
    Elsewhere,
    #[error("cannot be read")]
    Unreadable(#[from] hdf5::Error),
    #[error("cannot be read")]
    UnreadableNpz(#[from] io::Error),
}

impl ArrayProblem {
    pub(crate) fn in_array(self, array: &str) -> Problem {
        Problem::Array(array.to_owned(), self)
    }
}

/// Problem with rows of an array, which count from 0. The number is that of the first such row.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each is.
pub enum RowProblem {
    #[error("{0} is not a finite float32")]
    NotFinite(f32),
    #[error("{0} is neither 0 nor 1")]
    NotBoolean(f32),
    #[error("the action {0} is outside [-1, 1]")]
    ActionOutside(f32),
    #[error("not the observation of the next row, though the episode goes on")]
    Stray,
    #[error("the next place is more than {0} m away, though the episode goes on")]
    Leap(f32),
    #[error("the next state is as far away as after a reset, though the episode goes on")]
    Reset,
}

impl RowProblem {
    pub(crate) fn in_row(self, array: &str, row: usize) -> Problem {
        Problem::Rows(array.to_owned(), row, 1, self)
    }
}

/// Remedy for a foreign format.
#[derive(Clone, Copy, Debug)]
pub enum Load {
    /// Command of `quad-convert`, without its `--out`.
    Convert(&'static str),
    /// Advice on loading it in Python.
    Python(&'static str),
    /// Advice on getting the file that this one stands for.
    Get(&'static str),
}

/// The shape of an array; that of one number a row has no second axis.
fn shape([rows, width]: [usize; 2]) -> String {
    match width {
        1 => format!("[{rows}]"),
        _ => format!("[{rows}, {width}]"),
    }
}

pub(crate) fn such_rows(rows: usize) -> String {
    match rows {
        1 => String::new(),
        _ => format!(" ({rows} such rows)"),
    }
}

/// Advice on an array that is missing where there are others.
fn missing(array: &str, there: &[String]) -> String {
    let advice = match array == "rewards" {
        true => {
            "learning needs a reward for each step; a task such as antmaze-large-navigate-singletask-task1-v0 has those of OGBench's mazes, and with quad_rl installed, `quad-convert ogbench:NAME --out FILE` adds others"
        }
        false => ARRAYS,
    };
    match there.len() {
        0 => advice.to_owned(),
        1..=MOST_NAMES => format!("in its place are {}; {advice}", there.join(", ")),
        _ => format!("in its place are {}, …; {advice}", there[..MOST_NAMES].join(", ")),
    }
}

impl Problem {
    /// Advice on how to fix it.
    pub fn hint(&self) -> String {
        use {ArrayProblem as A, RowProblem as R};
        let hint = match self {
            Self::OtherEnvironment(claimed, _, true) => {
                return format!("choose a task in {claimed}, or another dataset");
            }
            Self::OtherEnvironment(_, expected, false) => {
                return format!(
                    "it is another simulation, so a policy that learns from it cannot be scored in {expected}; train under a name of \
                     your own, without evaluations: --task own-data --env NAME"
                );
            }
            Self::Foreign(_, Load::Convert(command)) => {
                return format!(
                    "with quad_rl installed, `{command} --out my-robot.hdf5` makes a file that is read (docs/data.md)"
                );
            }
            Self::Foreign(_, Load::Python(advice)) => {
                return format!(
                    "{advice}; then write its numbers to an HDF5 file of your own by the ten lines of h5py in docs/data.md"
                );
            }
            Self::Foreign(_, Load::Get(advice)) => advice,
            Self::Array(array, A::Missing(there)) => return missing(array, there),
            Self::Array(_, A::Unreadable(source)) if source.to_string().contains(NEWER) => {
                return format!("a newer HDF5 library wrote it: {REWRITE}");
            }
            Self::Array(_, A::Unreadable(_) | A::UnreadableNpz(_))
            | Self::Truncated { .. }
            | Self::DamagedHdf5(_)
            | Self::DamagedNpz(_) => DAMAGED,
            Self::Array(_, A::Group) => {
                "write what is in the group as columns of one array; in a Minari folder, observations may be a Dict of arrays, and of a Dict of Dicts `quad-convert FOLDER --out my-robot.hdf5` makes one row, with quad_rl installed"
            }
            Self::Array(_, A::DiscreteActions) => {
                "store continuous actions as float32; where they leave [-1, 1], `learner train --normalize actions` scales them"
            }
            Self::Array(_, A::Axes(_)) => {
                "each row is a number or a row of numbers: flatten what has more axes, and make numbers of images first, as an encoder does"
            }
            Self::Array(_, A::Rows(shape, _) | A::Shape(shape, _)) if matches!(shape[..], [rows, columns] if rows < columns) => {
                TRANSPOSED
            }
            Self::Array(_, A::Type(..) | A::Rows(..) | A::Shape(..)) => ARRAYS,
            Self::Array(_, A::Oversized(..)) => {
                "the file is damaged, or most of these rows were never written: fetch or copy it again, or write only the rows that there are"
            }
            Self::Array(_, A::Filter(_) | A::Elsewhere) => REWRITE,
            Self::Rows(.., R::NotFinite(_)) => {
                "leave out or repair these rows: a single one would spoil every weight"
            }
            Self::Rows(.., R::NotBoolean(_)) => {
                "a flag is 0 or 1: of a discount, write 1 where it is 0, and else 0 (docs/data.md says what each flag means)"
            }
            Self::Rows(.., R::ActionOutside(_)) => {
                "`learner train --normalize actions` trains on them: it maps the least and the largest of each number to ±1, and the policy's actions back"
            }
            Self::Rows(.., R::Stray | R::Leap(_) | R::Reset) => {
                "keep the rows in the order of recording and mark where episodes end in `terminals` and `timeouts`; for rows in any other order set the attribute `layout` as docs/data.md describes"
            }
            Self::OtherMaze(_) => {
                "choose one of its own tasks, such as antmaze-large-navigate-singletask-task1-v0, or another dataset"
            }
            Self::Width(..) => {
                "choose a dataset of that environment, or a task in the environment it was recorded in"
            }
            Self::Io(_) => "check the path and its permissions",
            Self::UnknownFormat => {
                "a dataset is a D4RL file (.hdf5), a folder of Minari, an OGBench file (.npz), or your own HDF5 file as docs/data.md describes"
            }
            Self::UnknownFolder => {
                "give one file, or the folder of one Minari dataset, like ~/.minari/datasets/mujoco/hopper/medium-v0; with quad_rl installed, `quad-convert FOLDER … --episode file` makes a file of a folder of tables (docs/data.md)"
            }
            Self::Locked(_) => {
                "close it in that program; if none has it open, set HDF5_USE_FILE_LOCKING=FALSE and try again"
            }
            Self::NotClosed(_) => {
                "let that program close it; if the program is gone, `h5clear --status FILE` (of HDF5's tools) frees what it wrote"
            }
            Self::Metadata(_) | Self::Episodes(..) => {
                "fetch the Minari dataset again; metadata.json is what Minari writes beside the data"
            }
            Self::UnknownLayout(_) | Self::Names(..) => {
                "see docs/data.md for what the attribute means"
            }
            Self::Name(..) => {
                "numbers find their places on a robot by name: give each column one of its own, such as left_gripper and right_gripper, \
                 that is not empty and without control characters"
            }
            Self::Endless(_) => {
                "set `timeouts` to 1 at the last row of each episode that did not terminate"
            }
            Self::NoTransitions(_) => {
                "record more: a transition needs a row and the one that follows it"
            }
            Self::SameReturns => {
                "unless all rewards are alike, another reward rule learns from them: --set reward=as-is"
            }
            Self::Unlike(..) => {
                "files of one dataset have the same columns in the same order, and one layout: write one of them anew, or leave it out"
            }
            Self::Write(_) => "check that the disk has room and the folder is writable",
        };
        hint.to_owned()
    }
}

const ARRAYS: &str = "docs/data.md says which arrays a file must have, and of which shape and type; all need the same number of rows";

const TRANSPOSED: &str = "a row of the array is a step: are rows and columns swapped, as by MATLAB? this swaps them in your file: python -c \
    \"import h5py; f = h5py.File('FILE', 'r+'); [(f.pop(n), f.create_dataset(n, data=x)) for n, x in [(n, f[n][()].T) for n in f]]\"";

const DAMAGED: &str = "the file was cut off or damaged on its way: fetch or copy it again; the program that writes one of your own must close it";

/// Number of names that are listed.
const MOST_NAMES: usize = 8;

/// Part of libhdf5's message on a version of the format that it does not know.
const NEWER: &str = "bad version number";

const REWRITE: &str = "pip install h5py hdf5plugin; then write it again, with your names for OLD and NEW: python -c \"import h5py, \
    hdf5plugin; a, b = h5py.File('OLD'), h5py.File('NEW', 'w'); b.attrs.update(a.attrs); a.visititems(lambda name, x: \
    b.update({name: x[()]}) if isinstance(x, h5py.Dataset) else None)\"";
