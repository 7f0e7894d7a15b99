//! Checkpoints: the training's whole state, from which it goes on as if it had never stopped.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use quad_protocol::Hash;
use tracing::warn;

use super::durable;
use super::error::{RunDirError, io_error};

/// How many are kept: the newest, and those that step in for it should it turn out to be damaged.
const KEPT: usize = 3;
const SUFFIX: &str = ".safetensors";

/// The state after a gradient step.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Checkpoint {
    /// The step.
    pub step: u64,
    /// A safetensors file, as `Agent::save` makes it.
    pub state: Vec<u8>,
}

/// The folder `checkpoints` of a run. A file's name has the step and the beginning of the BLAKE3 hash of its contents.
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
        durable::replace(&target, &checkpoint.state)?;
        for older in self.files()?.into_iter().skip(KEPT) {
            // One file too many does no harm.
            fs::remove_file(older).ok();
        }
        Ok(())
    }

    /// The newest that is whole. Those that are not get another ending, so that they do not count as checkpoints any more;
    /// those that cannot be read stay as they are.
    ///
    /// # Errors
    /// None is whole, and one cannot be read: it may be readable later, and a run should not begin anew before.
    pub fn newest(&self) -> Result<Option<Checkpoint>, RunDirError> {
        let mut unreadable = None;
        for path in self.files()? {
            let state = match fs::read(&path) {
                Ok(state) => state,
                Err(error) => {
                    warn!("{} cannot be read ({error}); the checkpoint before it is taken", path.display());
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
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn checkpoint(step: u64) -> Checkpoint {
        Checkpoint { step, state: vec![step as u8; 1000] }
    }

    #[test]
    fn the_newest_are_kept_and_a_damaged_one_falls_back_to_the_one_before() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoints = Checkpoints::of_run(folder.path());
        fs::create_dir(&checkpoints.folder).unwrap();
        assert_eq!(checkpoints.newest().unwrap(), None);
        for step in [1, 9, 10, 200, 1_000_000_000] {
            checkpoints.save(&checkpoint(step)).unwrap();
            assert_eq!(checkpoints.newest().unwrap(), Some(checkpoint(step)));
        }
        let files = checkpoints.files().unwrap();
        assert_eq!(files.iter().map(|file| step(file).unwrap()).collect::<Vec<_>>(), [1_000_000_000, 200, 10]);

        // Torn, then a flipped bit, then gone; and what a crash leaves beside them.
        fs::write(&files[0], &checkpoint(0).state[..500]).unwrap();
        assert_eq!(checkpoints.newest().unwrap(), Some(checkpoint(200)));
        let mut bytes = fs::read(&files[1]).unwrap();
        bytes[700] ^= 1;
        fs::write(&files[1], bytes).unwrap();
        fs::write(checkpoints.folder.join("step_000000300_00.safetensors.partial"), "half").unwrap();
        assert_eq!(checkpoints.newest().unwrap(), Some(checkpoint(10)));
        assert_eq!(checkpoints.files().unwrap(), files[2..], "damaged ones do not take the place of good ones");
        fs::remove_file(&files[2]).unwrap();
        assert_eq!(checkpoints.newest().unwrap(), None);
    }

    #[test]
    fn one_that_cannot_be_read_falls_back_and_does_not_count_as_none() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoints = Checkpoints::of_run(folder.path());
        fs::create_dir(&checkpoints.folder).unwrap();
        // A folder cannot be read as a file, not even by root.
        let unreadable = checkpoints.folder.join("step_000000300_00.safetensors");
        fs::create_dir_all(&unreadable).unwrap();
        let error = checkpoints.newest().unwrap_err();
        assert!(matches!(error, RunDirError::Io { action: "read", ref path, .. } if *path == unreadable), "{error}");
        checkpoints.save(&checkpoint(200)).unwrap();
        assert_eq!(checkpoints.newest().unwrap(), Some(checkpoint(200)));
        assert!(unreadable.exists());
    }
}
