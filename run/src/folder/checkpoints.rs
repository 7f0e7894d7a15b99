//! Checkpoints: complete training states, from which a run resumes bit for bit.

use std::cmp::Reverse;
use std::fs;
use std::path::{Path, PathBuf};

use quad_protocol::Hash;
use tracing::warn;

use super::error::{RunDirError, io_error};
use super::run_dir::{CHECKPOINTS, RunDir};
use crate::files;

const SUFFIX: &str = ".safetensors";

/// The training state after a gradient step.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Checkpoint {
    /// The gradient step.
    pub step: u64,
    /// A safetensors file, from `Agent::save`.
    pub state: Vec<u8>,
}

impl Checkpoint {
    /// Checkpoints that a run keeps: the newest, and two in case it is damaged.
    pub const KEPT: usize = 3;
}

impl RunDir {
    /// Saves a training state, durably, and removes all but the newest three.
    pub fn write_checkpoint(&self, checkpoint: &Checkpoint) -> Result<(), RunDirError> {
        self.make_folder(CHECKPOINTS)?;
        let target = self.path().join(CHECKPOINTS).join(file_name(checkpoint));
        files::replace(&target, &checkpoint.state).map_err(io_error("write", &target))?;
        for older in self.checkpoints()?.into_iter().skip(Checkpoint::KEPT) {
            // One file too many does no harm.
            fs::remove_file(older).ok();
        }
        Ok(())
    }

    /// The newest training state that is not damaged. Damaged ones are renamed, so that they no longer
    /// count; unreadable ones stay. If none is undamaged and one is unreadable, this is an error: it
    /// may be readable later, and the run must not begin anew before.
    pub fn newest_checkpoint(&self) -> Result<Option<Checkpoint>, RunDirError> {
        let mut unreadable = None;
        for path in self.checkpoints()? {
            let shown = path.display();
            let state = match files::read(&path) {
                Ok(state) => state,
                Err(error) => {
                    warn!("{shown} cannot be read ({error}); the checkpoint before it is taken");
                    unreadable.get_or_insert(io_error("read", &path)(error));
                    continue;
                }
            };
            let checkpoint = step(&path).map(|step| Checkpoint { step, state });
            if let Some(whole) =
                checkpoint.filter(|checkpoint| path.ends_with(file_name(checkpoint)))
            {
                return Ok(Some(whole));
            }
            warn!("{shown} is damaged; the checkpoint before it is taken");
            fs::rename(&path, path.with_extension("damaged")).map_err(io_error("rename", &path))?;
        }
        unreadable.map_or(Ok(None), Err)
    }

    /// The gradient step of the newest training state, which may be damaged.
    pub fn checkpoint_step(&self) -> Result<Option<u64>, RunDirError> {
        Ok(self.checkpoints()?.first().and_then(|path| step(path)))
    }

    /// The files of all checkpoints, the newest first.
    fn checkpoints(&self) -> Result<Vec<PathBuf>, RunDirError> {
        let folder = self.path().join(CHECKPOINTS);
        let entries = files::optional(fs::read_dir(&folder)).map_err(io_error("read", &folder))?;
        let paths = entries.into_iter().flatten().flatten().map(|entry| entry.path());
        let mut files = Vec::from_iter(paths.filter(|path| step(path).is_some()));
        files.sort_unstable_by_key(|path| Reverse(step(path)));
        Ok(files)
    }
}

/// A file's name has the step and the beginning of the BLAKE3 hash of its contents.
fn file_name(Checkpoint { step, state }: &Checkpoint) -> String {
    let hash = Hash::new(state).to_string();
    format!("step_{step:09}_{}{SUFFIX}", &hash[..16])
}

/// The step in the name of a checkpoint's file.
fn step(path: &Path) -> Option<u64> {
    let name = path.file_name()?.to_str()?.strip_prefix("step_")?.strip_suffix(SUFFIX)?;
    name.split_once('_')?.0.parse().ok()
}

#[cfg(test)]
mod tests;
