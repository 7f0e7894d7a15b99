//! Append-only files.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};
use tracing::warn;

use super::error::{RunDirError, content, io_error};
use super::lock::Lock;
use crate::files;

/// A file of JSON lines, or of other records, opened for appending.
#[derive(Debug)]
pub struct Log {
    path: PathBuf,
    file: File,
    /// Length of the complete lines, bytes.
    length: u64,
    /// True if an incomplete line may follow them.
    torn: bool,
    /// True if each write is synchronized.
    durable: bool,
    /// The run's other logs have the same writer and need no lock.
    _lock: Option<Lock>,
}

impl Log {
    /// Opens or creates a file of lines and cuts off an append at its end that was not completed. A
    /// log with a lock is durable.
    pub(super) fn open(path: PathBuf, lock: Option<Lock>) -> Result<Self, RunDirError> {
        let mut file = files::append(&path).map_err(io_error("open", &path))?;
        let text = files::rest(&mut file, 0).map_err(io_error("read", &path))?;
        let length = if lock.is_some() { whole_lines(&text) } else { complete_lines(&text) };
        let log = Self::cut(path, file, length as u64, lock.is_some())?;
        Ok(Self { _lock: lock, ..log })
    }

    /// A log of the first `length` bytes of a file, whose rest is cut off.
    pub(super) fn cut(
        path: PathBuf,
        file: File,
        length: u64,
        durable: bool,
    ) -> Result<Self, RunDirError> {
        let end = file.metadata().map_err(io_error("read", &path))?.len();
        if durable && end > length {
            let (path, dropped) = (path.display(), end - length);
            warn!("{path}: the last write was not completed; its {dropped} bytes are dropped");
        }
        let mut log = Self { path, file, length, torn: true, durable, _lock: None };
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
            let after = self.durable.then_some(self.length);
            serde_json::to_writer(&mut text, &Line { fields: line, after })
                .map_err(|error| content(&self.path, None, error))?;
            text.push(b'\n');
        }
        self.append_bytes(&text)
    }

    /// Appends bytes: all of them, or none if it fails.
    pub(super) fn append_bytes(&mut self, bytes: &[u8]) -> Result<(), RunDirError> {
        self.write(bytes).map_err(io_error("write", &self.path))
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.mend()?;
        self.torn = true;
        let written = self.file.write_all(bytes).and_then(|()| self.synchronize());
        match written {
            Ok(()) => {
                self.torn = false;
                self.length += bytes.len() as u64;
            }
            // If this fails, too, the next write tries it again.
            Err(_) => drop(self.mend()),
        }
        written
    }

    fn synchronize(&self) -> io::Result<()> {
        if self.durable { self.file.sync_data() } else { Ok(()) }
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
        let bytes = files::rest(&mut self.file, 0).map_err(io_error("read", &self.path))?;
        let lines = bytes.split_inclusive(|&byte| byte == b'\n');
        let kept = lines.take_while(|line| std::str::from_utf8(line).is_ok_and(&mut keep));
        self.length = kept.map(|line| line.len() as u64).sum();
        self.torn = true;
        self.mend().map_err(io_error("write", &self.path))
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

/// A line with its place.
#[derive(Serialize, Deserialize)]
struct Line<T> {
    #[serde(flatten)]
    fields: T,
    /// Bytes of a durable log that were on the disk before the line's append.
    #[serde(skip_serializing_if = "Option::is_none")]
    after: Option<u64>,
}

/// Length of the lines of a durable log, bytes, without those of an append that a power cut has
/// torn: any part of it may be missing. Damage before the last append counts as lines.
pub(super) fn whole_lines(text: &[u8]) -> usize {
    let complete = complete_lines(text);
    let (mut end, mut damaged) = (0, complete);
    for line in text[..complete].split_inclusive(|&byte| byte == b'\n') {
        match serde_json::from_slice::<Line<IgnoredAny>>(line) {
            Ok(Line { after, .. }) if after.unwrap_or(end as u64) > damaged as u64 => {
                return complete;
            }
            Ok(_) => {}
            Err(_) => damaged = damaged.min(end),
        }
        end += line.len();
    }
    damaged
}

/// Length of the complete lines, bytes.
fn complete_lines(text: &[u8]) -> usize {
    text.iter().rposition(|&byte| byte == b'\n').map_or(0, |last| last + 1)
}

#[cfg(test)]
mod tests {
    use std::fs::{self, OpenOptions};

    use super::*;

    #[test]
    fn what_a_full_disk_has_torn_off_is_cut_off_by_the_next_write() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let mut log = Log::cut(path.clone(), files::append(&path).unwrap(), 0, true).unwrap();
        log.append_bytes(b"first,").unwrap();
        let full = OpenOptions::new().write(true).open("/dev/full").unwrap();
        let file = std::mem::replace(&mut log.file, full);
        let error = log.append_bytes(b"second,").unwrap_err();
        assert!(error.hint().contains("make room"), "{error:?}");
        fs::write(&path, "first,sec").unwrap();
        log.file = file;
        log.append_bytes(b"third,").unwrap();
        assert_eq!(fs::read_to_string(path).unwrap(), "first,third,");
    }
}
