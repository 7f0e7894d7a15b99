//! Finds the folders of runs below other folders.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};

use super::folder::RunDir;

/// A folder that holds a run, or those of such folders at any depth below it, in alphabetical
/// order. Folders that cannot be read are handed to `unreadable`.
pub fn walk(path: &Path, unreadable: &mut impl FnMut(&Path, io::Error)) -> Vec<PathBuf> {
    if RunDir::is_occupied(path) {
        return vec![path.to_owned()];
    }
    let entries = std::fs::read_dir(path).map_err(|error| unreadable(path, error));
    // Links are not followed: they may lead back.
    let entries = entries.into_iter().flatten().flatten();
    let folders = entries
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()))
        .map(|entry| entry.path());
    let folders: BTreeSet<PathBuf> = folders.collect();
    folders.iter().flat_map(|folder| walk(folder, unreadable)).collect()
}
