//! The one way to open and the one way to make a file in a run's folder, for all programs.
//!
//! Another user may have made the folder. So a file there is opened through no link, and a pipe or
//! a device in its place is neither waited for nor read without end. A file is made beside its
//! place under a random name, and renamed when it is whole: what was there before, or all of the
//! new contents, also after a power cut. The tests find every other call.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use rustix::fs::OFlags;
use rustix::io::Errno;

/// Ending of a file that is being written.
const PARTIAL: &str = "partial";
/// The most that is read of a file, bytes: a checkpoint of networks as large as evaluators take has
/// less.
const LARGEST: u64 = 2 << 30;

/// Opens a file of a run's folder for reading.
///
/// # Errors
/// There is none, or it is a link, a pipe or a device.
pub fn open(path: &Path) -> io::Result<File> {
    open_as(OpenOptions::new().read(true), OFlags::NOFOLLOW, path)
}

/// As [`open`], for a path that the user has named: it may be a link.
///
/// # Errors
/// There is no file, or it is a pipe or a device.
pub fn open_named(path: &Path) -> io::Result<File> {
    open_as(OpenOptions::new().read(true), OFlags::empty(), path)
}

/// Opens a file for appending and reading; makes it if there is none.
///
/// # Errors
/// It is a link, a pipe or a device, or cannot be written to.
pub fn append(path: &Path) -> io::Result<File> {
    open_as(OpenOptions::new().create(true).read(true).append(true), OFlags::NOFOLLOW, path)
}

fn open_as(options: &mut OpenOptions, link: OFlags, path: &Path) -> io::Result<File> {
    // Else the system waits for the other end of a pipe.
    let flags = link | OFlags::NONBLOCK | OFlags::NOCTTY;
    let file = options.custom_flags(flags.bits() as i32).open(path).map_err(|error| {
        let is_none = matches!(Errno::from_io_error(&error), Some(Errno::LOOP | Errno::NXIO));
        if is_none { no_file() } else { error }
    })?;
    if file.metadata()?.is_file() { Ok(file) } else { Err(no_file()) }
}

pub(crate) fn no_file() -> io::Error {
    io::Error::other("it is a link, a pipe or a device, not a file")
}

/// Reads a file of a run's folder.
///
/// # Errors
/// Those of [`open`] and [`rest`].
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    rest(&mut open(path)?, 0)
}

/// Reads a file whose path the user has named.
///
/// # Errors
/// Those of [`open_named`] and [`rest`].
pub fn read_named(path: &Path) -> io::Result<Vec<u8>> {
    rest(&mut open_named(path)?, 0)
}

/// Reads a text file of a run's folder.
///
/// # Errors
/// Those of [`read`], or it is not UTF-8.
pub fn read_text(path: &Path) -> io::Result<String> {
    String::from_utf8(read(path)?)
        .map_err(|_| io::Error::new(ErrorKind::InvalidData, "it is not UTF-8"))
}

/// What a file has from a byte on.
///
/// # Errors
/// That is too large, or cannot be read.
pub fn rest(file: &mut File, from: u64) -> io::Result<Vec<u8>> {
    let length = file.metadata()?.len().saturating_sub(from);
    if length > LARGEST {
        return Err(io::Error::new(
            ErrorKind::FileTooLarge,
            format!("it is too large, with {length} bytes"),
        ));
    }
    let mut bytes = Vec::new();
    bytes.try_reserve_exact(length as usize)?;
    file.seek(SeekFrom::Start(from))?;
    file.take(LARGEST).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Makes the file `target`, or puts it in the place of one, durably.
///
/// # Errors
/// It cannot be written: then what was there stays.
pub fn replace(target: &Path, bytes: &[u8]) -> io::Result<()> {
    let partial = target.with_added_extension(format!("{:08x}.{PARTIAL}", rand::random::<u32>()));
    let mut file = File::create_new(&partial)?;
    file.write_all(bytes)
        .and_then(|()| file.sync_all())
        .and_then(|()| fs::rename(&partial, target))
        .and_then(|()| synchronize_folder(target))
        .inspect_err(|_| {
            // On a full disk the half file would keep others from being written.
            fs::remove_file(&partial).ok();
        })
}

/// Removes a file, if it is there.
pub(crate) fn remove_if_there(path: &Path) -> io::Result<()> {
    fs::remove_file(path)
        .or_else(|error| if error.kind() == ErrorKind::NotFound { Ok(()) } else { Err(error) })
}

/// Removes the half files that killed processes have left in a folder. One that stays does no harm
/// but to take room.
pub(crate) fn remove_partial_files(folder: &Path) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        let is_partial = entry.path().extension().is_some_and(|ending| ending == PARTIAL);
        if is_partial && entry.file_type().is_ok_and(|kind| kind.is_file() || kind.is_symlink()) {
            fs::remove_file(entry.path()).ok();
        }
    }
}

/// Makes a folder and those above it that are missing, so that a power cut does not take what will
/// be in them.
pub(crate) fn create_folder(path: &Path) -> io::Result<()> {
    if path.is_dir() {
        return Ok(());
    }
    if let Some(parent) = path.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        create_folder(parent)?;
    }
    fs::create_dir(path)?;
    synchronize_folder(path)
}

/// Makes the names in the folder that `path` lies in durable.
///
/// # Errors
/// The folder cannot be opened or synchronized.
pub fn synchronize_folder(path: &Path) -> io::Result<()> {
    let folder =
        path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}

#[cfg(test)]
mod tests;
