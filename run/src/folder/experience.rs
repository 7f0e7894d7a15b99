//! Experience on disk: `experience.log`.
//!
//! A record is the length of its frame (u32, little-endian), the frame's BLAKE3 hash and the frame,
//! a [`Record`].

use std::path::Path;

use quad_protocol::{Hash, Record, decode, encode};

use super::error::{RunDirError, content, io_error};
use super::log::Log;
use super::run_dir::{EXPERIENCE, RunDir};
use crate::files;

/// Bytes of a record before its frame.
const HEADER: usize = 4 + 32;

/// `experience.log`, opened for appending.
#[derive(Debug)]
pub struct ExperienceLog(Log);

impl ExperienceLog {
    /// Appends records, durably: all of them, or none if it fails.
    pub fn append(&mut self, records: &[Record]) -> Result<(), RunDirError> {
        let mut bytes = Vec::new();
        for record in records {
            let frame = encode(record).map_err(|error| content(self.0.path(), None, error))?;
            bytes.extend((frame.len() as u32).to_le_bytes());
            bytes.extend(Hash::of(&frame).bytes());
            bytes.extend(frame);
        }
        self.0.append_bytes(&bytes)
    }
}

impl RunDir {
    /// Opens or creates `experience.log` and cuts off an incomplete record at its end. Also returns
    /// the records. The lock on `scores.jsonl` keeps other writers out.
    pub fn experience_log(&self) -> Result<(ExperienceLog, Vec<Record>), RunDirError> {
        let (path, mut records) = (self.path().join(EXPERIENCE), Vec::new());
        let log = Log::of_records(path.clone(), true, |bytes| {
            let length;
            (records, length) = complete_records(&path, bytes)?;
            Ok(length)
        })?;
        Ok((ExperienceLog(log), records))
    }
}

/// Reads the complete records of `experience.log` in a run folder; a missing file has none.
pub fn read_experience(folder: &Path) -> Result<Vec<Record>, RunDirError> {
    let path = folder.join(EXPERIENCE);
    let bytes = files::optional(files::read(&path)).map_err(io_error("read", &path))?;
    Ok(complete_records(&path, &bytes.unwrap_or_default())?.0)
}

/// The complete records, and their length in bytes. A damaged one is an error, unless it may be an
/// incomplete one at the end.
fn complete_records(path: &Path, bytes: &[u8]) -> Result<(Vec<Record>, usize), RunDirError> {
    let (mut records, mut rest) = (Vec::new(), bytes);
    while let Some(frame) = first_frame(rest) {
        let number = records.len() + 1;
        let broken = |error| content(path, None, format!("record {number}: {error}"));
        records.push(decode(frame).map_err(broken)?);
        rest = &rest[HEADER + frame.len()..];
    }
    let length = bytes.len() - rest.len();
    if (1..rest.len()).any(|start| first_frame(&rest[start..]).is_some()) {
        let number = records.len() + 1;
        let reason =
            format!("record {number}, at byte {length}, is damaged, but one after it is complete");
        return Err(content(path, None, reason));
    }
    Ok((records, length))
}

/// The frame of the record that the bytes begin with, if it is complete.
fn first_frame(bytes: &[u8]) -> Option<&[u8]> {
    let (length, bytes) = bytes.split_first_chunk()?;
    let (hash, bytes) = bytes.split_first_chunk::<32>()?;
    let frame = bytes.get(..u32::from_le_bytes(*length) as usize)?;
    // Every frame begins so; else the search for a later one would hash each part of a damaged one.
    let is_complete = frame.starts_with(b"QUAD") && Hash::of(frame).bytes() == hash;
    is_complete.then_some(frame)
}

#[cfg(test)]
mod tests;
