//! Experience on disk: `experience.log`.
//!
//! A record is the length of a frame (u32, little-endian), its BLAKE3 hash and the frame: an
//! [`Episode`] as its evaluator has delivered it. Each record but the first of one append has its hash
//! inverted: a damaged record after which no append begins may be of the last one, torn by a power
//! cut.

use std::fs::File;
use std::io::{self, BufReader, ErrorKind, Read};
use std::path::Path;

use quad_protocol::{Episode, Hash, decode_kept};

use super::error::{RunDirError, content, io_error};
use super::log::Log;
use super::run_dir::{EXPERIENCE, RunDir};
use crate::files;

/// Bytes of a record before its frame.
const HEADER: usize = 4 + 32;
/// Every frame begins so.
const BEGIN: &[u8; 4] = b"QUAD";

/// `experience.log`, opened for appending.
#[derive(Debug)]
pub struct ExperienceLog(Log);

impl ExperienceLog {
    /// Appends frames, durably: all of them, or none if it fails.
    pub fn append<'a>(
        &mut self,
        frames: impl IntoIterator<Item = &'a [u8]>,
    ) -> Result<(), RunDirError> {
        let mut bytes = Vec::new();
        for frame in frames {
            let hash = *Hash::new(frame).bytes();
            let stored = if bytes.is_empty() { hash } else { inverted(hash) };
            bytes.extend((frame.len() as u32).to_le_bytes());
            bytes.extend(stored);
            bytes.extend(frame);
        }
        self.0.append_bytes(&bytes)
    }
}

impl RunDir {
    /// Opens or creates `experience.log` and cuts off an incomplete record at its end. Also returns
    /// the episodes and the hashes of their frames. The lock on `scores.jsonl` keeps other writers
    /// out.
    pub fn experience_log(&self) -> Result<(ExperienceLog, Vec<(Hash, Episode)>), RunDirError> {
        let path = self.path().join(EXPERIENCE);
        let mut file = files::append(&path).map_err(io_error("open", &path))?;
        let (records, length) = complete_records(&path, &mut file)?;
        Ok((ExperienceLog(Log::cut(path, file, length, true)?), records))
    }
}

/// Reads the episodes of the complete records of `experience.log` in a run folder; a missing file
/// has none.
pub fn read_experience(folder: &Path) -> Result<Vec<Episode>, RunDirError> {
    let path = folder.join(EXPERIENCE);
    let file = files::optional(files::open(&path)).map_err(io_error("read", &path))?;
    let Some(mut file) = file else { return Ok(Vec::new()) };
    let (records, _) = complete_records(&path, &mut file)?;
    Ok(records.into_iter().map(|(_, episode)| episode).collect())
}

fn inverted(hash: [u8; 32]) -> [u8; 32] {
    hash.map(|byte| !byte)
}

/// The complete records, and their length in bytes. A damaged one is an error, unless it may be of
/// the last append.
fn complete_records(
    path: &Path,
    file: &mut File,
) -> Result<(Vec<(Hash, Episode)>, u64), RunDirError> {
    let (mut records, mut length) = (Vec::new(), 0);
    let mut reader = BufReader::new(&*file);
    while let Some((hash, frame, _)) = next(&mut reader).map_err(io_error("read", path))? {
        let broken = |error| content(path, None, format!("record {}: {error}", records.len() + 1));
        records.push((hash, decode_kept(&frame).map_err(broken)?));
        length += (HEADER + frame.len()) as u64;
    }
    let rest = files::rest(file, length).map_err(io_error("read", path))?;
    let begins = |start: usize| matches!(next(&mut &rest[start..]), Ok(Some((.., true))));
    if (1..rest.len()).any(begins) {
        let number = records.len() + 1;
        let reason =
            format!("record {number}, at byte {length}, is damaged, but one after it is complete");
        return Err(content(path, None, reason));
    }
    Ok((records, length))
}

/// The hash and the frame of the next record, if it is complete, and whether it begins an append.
fn next(reader: &mut impl Read) -> io::Result<Option<(Hash, Vec<u8>, bool)>> {
    let mut begin = [0; HEADER + BEGIN.len()];
    match reader.read_exact(&mut begin) {
        Err(error) if error.kind() == ErrorKind::UnexpectedEof => return Ok(None),
        read => read?,
    }
    let mut frame = begin[HEADER..].to_vec();
    // Else the search for a later one would hash each part of a damaged one.
    if frame != BEGIN {
        return Ok(None);
    }
    let [a, b, c, d, ..] = begin;
    let length = u32::from_le_bytes([a, b, c, d]) as usize;
    reader.take(length.saturating_sub(BEGIN.len()) as u64).read_to_end(&mut frame)?;
    let hash = Hash::new(&frame);
    let stored = &begin[4..HEADER];
    let begins = hash.bytes() == stored;
    let is_complete = frame.len() == length && (begins || inverted(*hash.bytes()) == stored);
    Ok(is_complete.then_some((hash, frame, begins)))
}

#[cfg(test)]
pub(super) mod tests;
