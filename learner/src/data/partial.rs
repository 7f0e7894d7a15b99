//! Files that have arrived in part.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use quad_run::files;

/// The part of `<file>` that this process has fetched: `<file>.<number>.partial`.
pub struct Partial {
    pub path: PathBuf,
    pub length: u64,
    file: File,
}

impl Partial {
    /// Continues the part that an interrupted process has left of `target`, or makes an empty one.
    pub fn open(target: &Path) -> io::Result<Self> {
        let path = target.with_added_extension(format!("{:08x}.partial", rand::random::<u32>()));
        for (left, _) in partial_files(target) {
            // A process that is still fetching has a lock on its file.
            let Ok(file) = files::append(&left) else { continue };
            if file.try_lock().is_ok() && fs::rename(&left, &path).is_ok() {
                let length = file.metadata()?.len();
                return Ok(Self { path, length, file });
            }
        }
        let file = files::append(&path)?;
        // On a file system without locks, nothing is continued.
        file.try_lock().ok();
        Ok(Self { path, length: 0, file })
    }

    pub fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes)?;
        self.length += bytes.len() as u64;
        Ok(())
    }

    pub fn clear(&mut self) -> io::Result<()> {
        self.length = 0;
        self.file.set_len(0)
    }

    /// Renames the file to `target`, which is whole even after a power cut.
    pub fn finish(self, target: &Path) -> io::Result<()> {
        self.file.sync_all()?;
        fs::rename(&self.path, target)?;
        files::synchronize_folder(target)
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        if self.length == 0 {
            fs::remove_file(&self.path).ok();
        }
    }
}

/// The non-empty partial files of `target`, and their lengths.
pub fn partial_files(target: &Path) -> Vec<(PathBuf, u64)> {
    let folder = target.parent().and_then(|folder| fs::read_dir(folder).ok());
    let file = target.file_name().unwrap_or_default().to_string_lossy();
    let length = |entry: io::Result<fs::DirEntry>| {
        let path = entry.ok()?.path();
        let rest = path.file_name()?.to_str()?.strip_prefix(&*file)?;
        let length = path.metadata().ok()?.len();
        (rest.starts_with('.') && rest.ends_with(".partial") && length > 0)
            .then_some((path, length))
    };
    folder.into_iter().flatten().filter_map(length).collect()
}
