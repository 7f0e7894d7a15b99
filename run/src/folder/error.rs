//! Run folders that cannot be used.

use std::fmt::Display;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

/// The action of [`RunDirError::Io`] that makes a new folder.
pub(super) const CREATE: &str = "create";
/// The action of [`RunDirError::Io`] that makes a file of the user's.
pub(super) const SAVE: &str = "save";

/// A run folder that cannot be used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each variant is.
pub enum RunDirError {
    #[error("there is already a run in {0}")]
    Occupied(PathBuf),
    #[error("{0} is one of a run's own files")]
    Own(PathBuf),
    #[error("another learner is at work in {0}")]
    InUse(PathBuf),
    /// The file system has no locks, and the file names another host.
    #[error(
        "files have no locks there, and {0} names another host, on which a learner is or was at work"
    )]
    Claimed(PathBuf),
    #[error("the run's folder {0} was removed or renamed")]
    Gone(PathBuf),
    #[error("there is a run of another configuration in {path} ({differences})")]
    OtherConfig { path: PathBuf, differences: String },
    #[error("cannot {action} {path}")]
    Io { action: &'static str, path: PathBuf, source: io::Error },
    /// Lines are counted from 1.
    #[error("{path}{} is not what a learner writes: {reason}", line.map(|n| format!(", line {n},")).unwrap_or_default())]
    Content { path: PathBuf, line: Option<usize>, reason: String },
}

impl RunDirError {
    /// Tells the user how to fix it.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::Occupied(_) => {
                "give the command again to continue that run, or choose another folder by --run-dir"
            }
            Self::Own(_) => "choose another file",
            Self::Gone(_) => "put it back, and give the command again to continue; or begin anew",
            Self::Claimed(_) => {
                "wait for the end of that learner; if it is gone, as with its host, remove that file"
            }
            Self::InUse(_) => "wait for its end, or choose another folder by --run-dir",
            Self::OtherConfig { .. } => {
                "choose another --run-dir; or --fresh, which renames that folder and begins anew"
            }
            Self::Content { .. } => {
                "put a copy of the file in its place; --fresh renames the folder and begins anew. A line of scores.jsonl may \
                 also be taken out: its episode is scored again"
            }
            Self::Io { action: CREATE, .. } => {
                "choose a folder that you may write to with --run-dir DIR"
            }
            Self::Io { action: SAVE, .. } => {
                "name a file in a folder that is there and that you may write in"
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

pub(crate) fn io_error(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> RunDirError {
    let path = path.to_owned();
    move |source| RunDirError::Io { action, path, source }
}

pub(crate) fn content(path: &Path, line: Option<usize>, error: impl Display) -> RunDirError {
    RunDirError::Content { path: path.to_owned(), line, reason: error.to_string() }
}
