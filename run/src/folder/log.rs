//! Append-only files of JSON lines.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::error::{RunDirError, content, io_error};
use super::lock::Lock;
use crate::files;

/// A file of JSON lines, opened for appending.
#[derive(Debug)]
pub struct Log {
    path: PathBuf,
    file: File,
    /// Length of the complete lines, bytes.
    length: u64,
    /// True if an incomplete line may follow them.
    torn: bool,
    /// A log with a lock is synchronized after each write. The run's other log has the same writer
    /// and needs no lock.
    lock: Option<Lock>,
}

impl Log {
    /// Opens or creates the file and cuts off an incomplete line at its end.
    pub(super) fn open(path: PathBuf, lock: Option<Lock>) -> Result<Self, RunDirError> {
        let file = files::append(&path).map_err(io_error("open", &path))?;
        let mut log = Self { path, file, length: 0, torn: true, lock };
        log.length = complete_lines(&log.bytes()?) as u64;
        // Lines that a killed process did not synchronize count from now on.
        log.mend()
            .and_then(|()| log.synchronize())
            .and_then(|()| files::synchronize_folder(&log.path))
            .map_err(io_error("open", &log.path))?;
        Ok(log)
    }

    /// True if it has no complete line.
    pub fn is_empty(&self) -> bool {
        self.length == 0
    }

    /// Appends lines: all of them, or none if it fails.
    pub fn append<T: Serialize>(&mut self, lines: &[T]) -> Result<(), RunDirError> {
        let mut text = Vec::new();
        for line in lines {
            serde_json::to_writer(&mut text, line)
                .map_err(|error| content(&self.path, None, error))?;
            text.push(b'\n');
        }
        self.write(&text).map_err(io_error("write", &self.path))
    }

    fn write(&mut self, text: &[u8]) -> io::Result<()> {
        self.mend()?;
        self.torn = true;
        let written = self.file.write_all(text).and_then(|()| self.synchronize());
        match written {
            Ok(()) => {
                self.torn = false;
                self.length += text.len() as u64;
            }
            // If this fails, too, the next write tries it again.
            Err(_) => drop(self.mend()),
        }
        written
    }

    fn synchronize(&self) -> io::Result<()> {
        match &self.lock {
            Some(_) => self.file.sync_data(),
            None => Ok(()),
        }
    }

    /// Cuts off the incomplete line of a failed write, which would spoil the next line.
    fn mend(&mut self) -> io::Result<()> {
        if self.torn {
            self.file.set_len(self.length)?;
            self.torn = false;
        }
        Ok(())
    }

    /// Cuts off the first line that is not to be kept, and all lines after it.
    pub(super) fn keep_while(
        &mut self,
        mut keep: impl FnMut(&str) -> bool,
    ) -> Result<(), RunDirError> {
        // After a power cut, a file that was not synchronized may contain anything.
        let bytes = self.bytes()?;
        let lines = bytes.split_inclusive(|&byte| byte == b'\n');
        let kept = lines.take_while(|line| std::str::from_utf8(line).is_ok_and(&mut keep));
        self.length = kept.map(|line| line.len() as u64).sum();
        self.torn = true;
        self.mend().map_err(io_error("write", &self.path))
    }

    fn bytes(&mut self) -> Result<Vec<u8>, RunDirError> {
        files::rest(&mut self.file, 0).map_err(io_error("read", &self.path))
    }
}

/// Reads the complete lines of a file beyond its first `read` bytes, and adds their length to
/// `read`. A missing file has none; a file that has become shorter is read from its beginning.
pub fn new_lines(path: &Path, read: &mut u64) -> io::Result<Vec<u8>> {
    let Some(mut file) = files::optional(files::open(path))? else { return Ok(Vec::new()) };
    if file.metadata()?.len() < *read {
        *read = 0;
    }
    let mut lines = files::rest(&mut file, *read)?;
    lines.truncate(complete_lines(&lines));
    *read += lines.len() as u64;
    Ok(lines)
}

/// Length of the complete lines, bytes.
fn complete_lines(text: &[u8]) -> usize {
    text.iter().rposition(|&byte| byte == b'\n').map_or(0, |last| last + 1)
}
