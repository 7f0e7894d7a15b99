//! A disk after a power cut, at worst: it holds what was synchronized, and any part of what was not.
//!
//! A file has the contents of its last fsync and some pages of what was appended since, a folder the entries of its own last fsync, and an
//! entry that was never synchronized itself is empty. examples/power_cut.rs, preloaded into a
//! program, keeps such a [`Disk`] up to date.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use rand::Rng;

use crate::process::preload;

/// Variables with the two folders, for the preloaded library.
const FOLDER: &str = "QUAD_TESTS_DISK";
const KEPT: &str = "QUAD_TESTS_DISK_KEPT";

/// Bytes that a disk writes at once.
const PAGE: usize = 512;

/// A folder, and beside it what a power cut would leave of it.
pub struct Disk {
    folder: PathBuf,
    /// A file for each file and each folder, called by its identity: the contents, or a line for
    /// each entry.
    kept: PathBuf,
}

impl Disk {
    pub fn new(scratch: &Path) -> Disk {
        let disk = Disk { folder: scratch.join("disk"), kept: scratch.join("disk.kept") };
        fs::create_dir(&disk.folder).unwrap();
        disk.keep_all();
        disk
    }

    /// The disk that [`Disk::launcher`] names.
    pub fn of_environment() -> Disk {
        let folder = |variable: &str| {
            PathBuf::from(std::env::var_os(variable).expect("the launcher sets it"))
        };
        Disk { folder: folder(FOLDER), kept: folder(KEPT) }
    }

    /// Command line prefix of a program whose synchronizing is recorded.
    pub fn launcher(&self) -> Vec<String> {
        let set = |variable: &str, path: &Path| format!("{variable}={}", path.display());
        [preload("power_cut"), vec![set(FOLDER, &self.folder), set(KEPT, &self.kept)]].concat()
    }

    /// Keeps a file or folder as it is now, if it is on this disk. Whole or not at all, whenever
    /// the program dies.
    pub fn keep(&self, path: &Path) -> io::Result<()> {
        if !path.starts_with(&self.folder) {
            return Ok(());
        }
        let partial = self.kept.join("partial");
        if path.is_dir() {
            let entries = fs::read_dir(path)?.map(|entry| entry_line(&entry?));
            fs::write(&partial, entries.collect::<io::Result<String>>()?)?;
        } else {
            fs::copy(path, &partial)?;
        }
        fs::rename(partial, self.kept.join(identity(path)?))
    }

    /// Leaves in the folder what a power cut would leave. All of that is durable from then on.
    pub fn cut_power(&self, random: &mut impl Rng) {
        let restored = self.folder.with_extension("restored");
        let paths = self.paths().into_iter();
        let paths = paths.map(|path| (identity(&path).unwrap(), path)).collect();
        self.restore(&identity(&self.folder).unwrap(), &restored, &paths, random).unwrap();
        fs::remove_dir_all(&self.folder).unwrap();
        fs::rename(&restored, &self.folder).unwrap();
        fs::remove_dir_all(&self.kept).unwrap();
        self.keep_all();
    }

    fn keep_all(&self) {
        fs::create_dir(&self.kept).unwrap();
        self.paths().iter().for_each(|path| self.keep(path).unwrap());
    }

    /// All folders and files, each folder before what is in it.
    fn paths(&self) -> Vec<PathBuf> {
        let mut paths = vec![self.folder.clone()];
        let mut next = 0;
        while let Some(path) = paths.get(next).cloned() {
            if path.is_dir() {
                paths.extend(fs::read_dir(path).unwrap().map(|entry| entry.unwrap().path()));
            }
            next += 1;
        }
        paths
    }

    /// Makes a folder, of this identity, as it is after the cut; `paths` are those before it.
    fn restore(
        &self,
        folder: &str,
        target: &Path,
        paths: &BTreeMap<String, PathBuf>,
        random: &mut impl Rng,
    ) -> io::Result<()> {
        fs::create_dir(target)?;
        // One that was never synchronized has no entries.
        for line in fs::read_to_string(self.kept.join(folder)).unwrap_or_default().lines() {
            let mut words = line.splitn(3, ' ');
            let mut word = || words.next().expect("a line has three words");
            let (kind, identity, path) = (word(), word(), target.join(word()));
            let kept = self.kept.join(identity);
            match kind {
                "folder" => self.restore(identity, &path, paths, random)?,
                _ if kept.exists() => {
                    let written = paths.get(identity).map(fs::read).transpose()?;
                    fs::write(path, torn(fs::read(kept)?, &written.unwrap_or_default(), random))?;
                }
                _ => drop(File::create(path)?),
            }
        }
        Ok(())
    }
}

/// The contents of a file that has been `written` since it was `kept`: what was appended is there up
/// to some byte, without some of its pages.
fn torn(mut kept: Vec<u8>, written: &[u8], random: &mut impl Rng) -> Vec<u8> {
    let begin = kept.len();
    if written.starts_with(&kept) {
        kept.extend(&written[begin..random.random_range(begin..=written.len())]);
        for (number, page) in kept.chunks_mut(PAGE).enumerate().skip(begin / PAGE) {
            if random.random_bool(0.5) {
                page[begin.saturating_sub(number * PAGE)..].fill(0);
            }
        }
    }
    kept
}

fn entry_line(entry: &fs::DirEntry) -> io::Result<String> {
    let kind = if entry.file_type()?.is_dir() { "folder" } else { "file" };
    Ok(format!("{kind} {} {}\n", identity(&entry.path())?, entry.file_name().to_string_lossy()))
}

/// Identity of a file, also when it is renamed. Inode numbers are reused, so the time of birth belongs
/// to it where the filesystem has one.
fn identity(path: &Path) -> io::Result<String> {
    let metadata = fs::symlink_metadata(path)?;
    let born = metadata.created().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    Ok(format!("{}-{}", metadata.ino(), born.unwrap_or_default().as_nanos()))
}
