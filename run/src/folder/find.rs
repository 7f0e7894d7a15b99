//! Searches for the folders of runs.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};

use super::run_dir::RunDir;

/// Lists the run folders at and below a folder, in alphabetical order. Folders that cannot be read
/// are passed to `unreadable`.
pub fn walk(path: &Path, unreadable: &mut impl FnMut(&Path, io::Error)) -> Vec<PathBuf> {
    if RunDir::is_occupied(path) {
        return vec![path.to_owned()];
    }
    let entries = std::fs::read_dir(path).map_err(|error| unreadable(path, error));
    // Links are not followed: they may lead back.
    let folders = entries
        .into_iter()
        .flatten()
        .flatten()
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()))
        .map(|entry| entry.path());
    let folders = BTreeSet::from_iter(folders);
    folders.iter().flat_map(|folder| walk(folder, unreadable)).collect()
}
