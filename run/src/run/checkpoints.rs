//! Checkpoints: the training's whole state, from which it continues as if it had never stopped.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use quad_protocol::Hash;
use tracing::warn;

use super::error::{RunDirError, io_error};
use crate::files;

const SUFFIX: &str = ".safetensors";

/// The state after a gradient step.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Checkpoint {
    /// The step.
    pub step: u64,
    /// A safetensors file, as `Agent::save` makes it.
    pub state: Vec<u8>,
}

impl Checkpoint {
    /// How many a run keeps: the newest, and those that step in for it should it turn out to be
    /// damaged.
    pub const KEPT: usize = 3;
}

/// The folder `checkpoints` of a run. A file's name has the step and the beginning of the BLAKE3
/// hash of its contents.
#[derive(Clone, Debug)]
pub(super) struct Checkpoints {
    folder: PathBuf,
}

impl Checkpoints {
    pub fn of_run(run: &Path) -> Self {
        Self { folder: run.join("checkpoints") }
    }

    /// Saves one; only then are older ones removed.
    pub fn save(&self, checkpoint: &Checkpoint) -> Result<(), RunDirError> {
        let target = self.folder.join(file_name(checkpoint));
        files::replace(&target, &checkpoint.state).map_err(io_error("write", &target))?;
        for older in self.files()?.into_iter().skip(Checkpoint::KEPT) {
            // One file too many does no harm.
            fs::remove_file(older).ok();
        }
        Ok(())
    }

    /// The newest that is whole. Those that are not get another ending, so that they do not count
    /// as checkpoints any more; those that cannot be read stay as they are.
    ///
    /// # Errors
    /// None is whole, and one cannot be read: it may be readable later, and a run should not begin
    /// anew before.
    pub fn newest(&self) -> Result<Option<Checkpoint>, RunDirError> {
        let mut unreadable = None;
        for path in self.files()? {
            let state = match files::read(&path) {
                Ok(state) => state,
                Err(error) => {
                    warn!(
                        "{} cannot be read ({error}); the checkpoint before it is taken",
                        path.display()
                    );
                    unreadable.get_or_insert(io_error("read", &path)(error));
                    continue;
                }
            };
            let found = step(&path).map(|step| Checkpoint { step, state });
            if let Some(whole) = found.filter(|found| path.ends_with(file_name(found))) {
                return Ok(Some(whole));
            }
            warn!("{} is damaged; the checkpoint before it is taken", path.display());
            fs::rename(&path, path.with_extension("damaged")).map_err(io_error("rename", &path))?;
        }
        unreadable.map_or(Ok(None), Err)
    }

    /// All of them, newest first.
    fn files(&self) -> Result<Vec<PathBuf>, RunDirError> {
        let entries = match fs::read_dir(&self.folder) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            other => other.map_err(io_error("read", &self.folder))?,
        };
        let mut files: Vec<_> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
        files.retain(|path| step(path).is_some());
        files.sort_unstable_by_key(|path| std::cmp::Reverse(step(path)));
        Ok(files)
    }
}

fn file_name(Checkpoint { step, state }: &Checkpoint) -> String {
    let hash = Hash::of(state).to_string();
    format!("step_{step:09}_{}{SUFFIX}", &hash[..16])
}

/// The step that a file's name tells; none if it is not the name of a checkpoint.
fn step(path: &Path) -> Option<u64> {
    let name = path.file_name()?.to_str()?.strip_prefix("step_")?.strip_suffix(SUFFIX)?;
    name.split_once('_')?.0.parse().ok()
}

#[cfg(test)]
mod tests;
