//! Why a run folder cannot be used.

use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

/// What failed where a folder cannot be made, which has a hint of its own.
pub(super) const CREATE: &str = "create";

/// A run folder that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RunDirError {
    /// There is a run in it.
    #[error("there is already a run in {0}")]
    Occupied(PathBuf),
    /// Another learner works in it.
    #[error("another learner is at work in {0}")]
    InUse(PathBuf),
    /// Files have no locks there, and a learner on another host has claimed the folder by this
    /// file.
    #[error(
        "files have no locks there, and {0} names another host, on which a learner is or was at work"
    )]
    Claimed(PathBuf),
    /// The folder of a run at work is not there any more.
    #[error("the run's folder {0} was removed or renamed")]
    Gone(PathBuf),
    /// Reading or writing failed.
    #[error("cannot {action} {path}")]
    Io {
        /// The operation: "read", "write" …
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// A file of the run has contents that no learner writes.
    #[error("{path}{} is not what a learner writes: {reason}", line.map(|n| format!(", line {n},")).unwrap_or_default())]
    Content {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: Option<usize>,
        /// What is wrong.
        reason: String,
    },
}

impl RunDirError {
    /// What to do about it.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::Occupied(_) => {
                "give the command again to continue that run, or choose another folder by --run-dir"
            }
            Self::Gone(_) => "put it back, and give the command again to continue; or begin anew",
            Self::Claimed(_) => {
                "wait for the end of that learner; if it is gone, as with its host, remove that file"
            }
            Self::InUse(_) => "wait for its end, or choose another folder by --run-dir",
            Self::Content { .. } => {
                "put a copy of the file in its place; --fresh renames the folder and begins anew. A line of scores.jsonl may \
                 also be taken out: its episode is scored again"
            }
            Self::Io { action: CREATE, .. } => {
                "choose a folder that you may write to with --run-dir DIR"
            }
            Self::Io { source, .. } => match source.kind() {
                ErrorKind::NotFound | ErrorKind::NotADirectory => {
                    "is it a folder that `learner train` has written?"
                }
                ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => {
                    "see to it that you may read and write there, or choose another folder by --run-dir"
                }
                ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
                    "make room on that disk (docs/operations.md)"
                }
                _ => "`learner doctor --run-dir DIR` looks at the disk",
            },
        }
    }
}

pub(super) fn io_error(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> RunDirError {
    let path = path.to_owned();
    move |source| RunDirError::Io { action, path, source }
}

pub(super) fn content(
    path: &Path,
    line: Option<usize>,
    error: &dyn std::fmt::Display,
) -> RunDirError {
    RunDirError::Content { path: path.to_owned(), line, reason: error.to_string() }
}
