//! Files that are whole whatever happens: the old contents or the new ones, also after a power cut.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

use super::error::{RunDirError, io_error};

/// Ending of a file that is being written.
const PARTIAL: &str = "partial";

/// Replaces the file `target`: written beside it, synchronised, renamed, and the folder synchronised, without which a power
/// cut could undo the renaming.
pub(super) fn replace(target: &Path, bytes: &[u8]) -> Result<(), RunDirError> {
    let partial = target.with_added_extension(PARTIAL);
    write_synchronised(&partial, bytes)
        .and_then(|()| fs::rename(&partial, target))
        .and_then(|()| synchronise_folder(target))
        .inspect_err(|_| {
            // On a full disk the half file would keep others from being written.
            fs::remove_file(&partial).ok();
        })
        .map_err(io_error("write", target))
}

/// Opens a file for reading. In a folder that another user made, a pipe or a device in its place would have no end.
pub(crate) fn open_file(path: &Path) -> io::Result<File> {
    if fs::metadata(path)?.is_file() { File::open(path) } else { Err(io::Error::other("it is no file")) }
}

/// Removes the half files that killed processes have left in a folder, and links in their place, which writing would follow.
/// One that stays does no harm but to take room.
pub(super) fn remove_partial_files(folder: &Path) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        let is_partial = entry.path().extension().is_some_and(|ending| ending == PARTIAL);
        if is_partial && entry.file_type().is_ok_and(|kind| kind.is_file() || kind.is_symlink()) {
            fs::remove_file(entry.path()).ok();
        }
    }
}

fn write_synchronised(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::create(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}

/// Makes a folder and those above it that are missing, so that a power cut does not take what will be in them.
pub(super) fn create_folder(path: &Path) -> io::Result<()> {
    if path.is_dir() {
        return Ok(());
    }
    if let Some(parent) = path.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        create_folder(parent)?;
    }
    fs::create_dir(path)?;
    synchronise_folder(path)
}

/// Makes the names in the folder that `path` lies in durable.
pub(super) fn synchronise_folder(path: &Path) -> io::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}
