//! What has arrived of a file so far: `<file>.partial`, beside the place of the whole file.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Seek, SeekFrom, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use tracing::info;

/// A partial file. While it is open no other process opens it, so that two that fetch the same file do not mix.
pub struct Partial {
    path: PathBuf,
    file: File,
    length: u64,
    mixed: bool,
}

impl Partial {
    /// Opens the partial file of `target`, or makes an empty one; waits while another process has it.
    pub fn open(target: &Path) -> io::Result<Self> {
        let path = target.with_added_extension("partial");
        loop {
            let mut file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path)?;
            match file.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => {
                    info!("another process fetches {}; waiting for it", target.display());
                    file.lock()?;
                }
                Err(TryLockError::Error(error)) => return Err(error),
            }
            // Whoever had the lock may have renamed or removed the file since it was opened here.
            if is_at(&file, &path)? {
                let length = file.seek(SeekFrom::End(0))?;
                return Ok(Self { path, file, length, mixed: length > 0 });
            }
        }
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Bytes so far.
    pub fn len(&self) -> u64 {
        self.length
    }

    /// Whether some of it is from an earlier attempt, perhaps at another address, and may not fit what comes now.
    pub fn is_mixed(&self) -> bool {
        self.mixed
    }

    /// What comes from now on is from another address.
    pub fn change_address(&mut self) {
        self.mixed = self.length > 0;
    }

    /// Appends bytes.
    pub fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes)?;
        self.length += bytes.len() as u64;
        Ok(())
    }

    /// Forgets all bytes.
    pub fn clear(&mut self) -> io::Result<()> {
        self.file.set_len(0)?;
        self.mixed = false;
        self.length = self.file.seek(SeekFrom::Start(0))?;
        Ok(())
    }

    /// Removes it.
    pub fn discard(self) -> io::Result<()> {
        fs::remove_file(&self.path)
    }

    /// Gives it its final name, under which nobody ever sees less than the whole file, not even after a power cut.
    pub fn finish(self, target: &Path) -> io::Result<()> {
        self.file.sync_all()?;
        fs::rename(&self.path, target)?;
        let folder = target.parent().filter(|folder| !folder.as_os_str().is_empty());
        File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
    }
}

/// Whether an open file is the one at `path`.
fn is_at(file: &File, path: &Path) -> io::Result<bool> {
    let open = file.metadata()?;
    match fs::metadata(path) {
        Ok(there) => Ok((there.dev(), there.ino()) == (open.dev(), open.ino())),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}
