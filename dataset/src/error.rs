//! What can go wrong with a dataset file. Every message names the file, and where it can the array and the row.

use std::io;
use std::path::PathBuf;

/// A file that cannot be read, or written, as a D4RL dataset.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The operating system refused.
    #[error("{}: cannot be opened or written", .path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// HDF5 does not recognise the file as a whole one of its own.
    #[error("{}: not an HDF5 file, or a damaged or incomplete one", .path.display())]
    NotHdf5 {
        /// The file.
        path: PathBuf,
        /// HDF5's own words.
        source: hdf5::Error,
    },
    /// An array that D4RL's layout asks for is absent.
    #[error("{}: array `{array}` is missing", .path.display())]
    Missing {
        /// The file.
        path: PathBuf,
        /// The array's path within it.
        array: &'static str,
    },
    /// An array holds another kind of elements.
    #[error("{}: array `{array}` holds {found}, but must hold {expected}", .path.display())]
    Type {
        /// The file.
        path: PathBuf,
        /// The array's path within it.
        array: &'static str,
        /// What it holds.
        found: String,
        /// What it must hold.
        expected: &'static str,
    },
    /// An array has another shape than the environment and the other arrays ask for.
    #[error("{}: array `{array}` has shape {found:?}, but must have {expected:?}", .path.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// The array's path within it.
        array: &'static str,
        /// Its shape.
        found: Vec<usize>,
        /// The shape it must have.
        expected: Vec<usize>,
    },
    /// An array claims more elements than a file of that size can hold.
    #[error("{}: array `{array}` claims the shape {found:?}, more than a file of {bytes} bytes can hold", .path.display())]
    Oversized {
        /// The file.
        path: PathBuf,
        /// The array's path within it.
        array: &'static str,
        /// Its shape.
        found: Vec<usize>,
        /// Size of the file.
        bytes: u64,
    },
    /// HDF5 fails in the middle of an array.
    #[error("{}: array `{array}` cannot be read", .path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The array's path within it.
        array: &'static str,
        /// HDF5's own words.
        source: hdf5::Error,
    },
    /// NaN or an infinity.
    #[error("{}: array `{array}`, row {row}: {value} is not a finite float32", .path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The array's path within it.
        array: &'static str,
        /// The first such row, from 0.
        row: usize,
        /// What is there.
        value: f64,
    },
    /// A flag that is neither 0 nor 1.
    #[error("{}: array `{array}`, row {row}: {value} is neither 0 nor 1", .path.display())]
    NotBoolean {
        /// The file.
        path: PathBuf,
        /// The array's path within it.
        array: &'static str,
        /// The first such row, from 0.
        row: usize,
        /// What is there.
        value: i8,
    },
    /// The rules leave no transition (the last row and timeouts are dropped).
    #[error("{}: {rows} rows, of which none makes a transition", .path.display())]
    NoTransitions {
        /// The file.
        path: PathBuf,
        /// Rows in it.
        rows: usize,
    },
    /// The locomotion rule divides by the spread of the trajectories' returns, and there is none.
    #[error("{}: all trajectories have the same return, so the reward rule `locomotion` cannot scale them", .path.display())]
    SameReturns {
        /// The file.
        path: PathBuf,
    },
    /// HDF5 fails while writing.
    #[error("{}: cannot be written", .path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// HDF5's own words.
        source: hdf5::Error,
    },
    /// A row that would make the file unreadable.
    #[error("{}: row {row} cannot be written: `{array}` {problem}", .path.display())]
    BadRow {
        /// The file.
        path: PathBuf,
        /// The row's number, from 0.
        row: usize,
        /// The array's path within the file.
        array: &'static str,
        /// What is wrong.
        problem: String,
    },
}
