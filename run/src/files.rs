//! The one way to open and the one way to make a file in a run's folder, for all programs.
//!
//! Another user may have made the folder, so links are not followed, and pipes and devices are not
//! read. A new file is written under a random name, then renamed: after a power cut the old or the new
//! contents are there, never a part. A test finds every other call.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use rustix::fs::OFlags;
use rustix::io::Errno;

/// Ending of a file that is being written.
const PARTIAL: &str = "partial";
/// Most bytes that are read of a file; checkpoints of the largest networks have fewer.
const LARGEST: u64 = 2 << 30;

/// Opens a file of a run's folder for reading; links, pipes and devices are errors.
pub fn open(path: &Path) -> io::Result<File> {
    open_as(OpenOptions::new().read(true), OFlags::NOFOLLOW, path)
}

/// As [`open`], for a path that the user has named: it may be a link.
pub fn open_named(path: &Path) -> io::Result<File> {
    open_as(OpenOptions::new().read(true), OFlags::empty(), path)
}

/// Opens or makes a file for appending and reading; links, pipes and devices are errors.
pub fn append(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    open_as(options.create(true).read(true).append(true), OFlags::NOFOLLOW, path)
}

fn open_as(options: &mut OpenOptions, link: OFlags, path: &Path) -> io::Result<File> {
    // Without NONBLOCK, the system waits for the other end of a pipe.
    let flags = link | OFlags::NONBLOCK | OFlags::NOCTTY;
    let opened = options.custom_flags(flags.bits() as i32).open(path);
    let file = opened.map_err(|error| match Errno::from_io_error(&error) {
        Some(Errno::LOOP | Errno::NXIO) => no_file(),
        _ => error,
    })?;
    let metadata = file.metadata()?;
    match metadata.is_file() {
        true => Ok(file),
        false if metadata.is_dir() => Err(io::Error::other("it is a folder, not a file")),
        false => Err(no_file()),
    }
}

pub(crate) fn no_file() -> io::Error {
    io::Error::other("it is a link, a pipe or a device, not a file")
}

/// Reads a file of a run's folder.
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    rest(&mut open(path)?, 0)
}

/// Reads a file whose path the user has named.
pub fn read_named(path: &Path) -> io::Result<Vec<u8>> {
    rest(&mut open_named(path)?, 0)
}

/// Reads a text file of a run's folder.
pub fn read_text(path: &Path) -> io::Result<String> {
    String::from_utf8(read(path)?)
        .map_err(|_| io::Error::new(ErrorKind::InvalidData, "it is not UTF-8"))
}

/// Reads a file from an offset to its end.
pub fn rest(file: &mut File, from: u64) -> io::Result<Vec<u8>> {
    let length = file.metadata()?.len().saturating_sub(from);
    if length > LARGEST {
        let problem = format!("it is too large, with {length} bytes");
        return Err(io::Error::new(ErrorKind::FileTooLarge, problem));
    }
    let mut bytes = Vec::new();
    bytes.try_reserve_exact(length as usize)?;
    file.seek(SeekFrom::Start(from))?;
    file.take(LARGEST).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Makes or replaces the file `target`, durably. After an error, the old file is still there, unless
/// only the folder could not be synchronized.
pub fn replace(target: &Path, bytes: &[u8]) -> io::Result<()> {
    let partial = target.with_added_extension(format!("{:08x}.{PARTIAL}", rand::random::<u32>()));
    let mut file = File::create_new(&partial)?;
    file.write_all(bytes)
        .and_then(|()| file.sync_all())
        .and_then(|()| fs::rename(&partial, target))
        .and_then(|()| synchronize_folder(target))
        .inspect_err(|_| {
            // On a full disk, the partial file would take the room of others.
            fs::remove_file(&partial).ok();
        })
}

/// `None` if a file or folder does not exist.
pub(crate) fn optional<T>(result: io::Result<T>) -> io::Result<Option<T>> {
    match result {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        other => other.map(Some),
    }
}

/// Removes the partial files of killed processes in a folder.
pub(crate) fn remove_partial_files(folder: &Path) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        // This fails for folders.
        if entry.path().extension().is_some_and(|ending| ending == PARTIAL) {
            fs::remove_file(entry.path()).ok();
        }
    }
}

/// Makes a folder and its missing parents, durably.
pub(crate) fn create_folder(path: &Path) -> io::Result<()> {
    if path.is_dir() {
        return Ok(());
    }
    if let Some(parent) = path.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        create_folder(parent)?;
    }
    match fs::create_dir(path) {
        // Of two learners that begin at once, the other made it.
        Err(error) if error.kind() != ErrorKind::AlreadyExists || !path.is_dir() => Err(error),
        _ => synchronize_folder(path),
    }
}

/// Makes the names in the folder of `path` durable.
pub fn synchronize_folder(path: &Path) -> io::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
}

#[cfg(test)]
mod tests;
