//! Files of the catalog, from the cache folder or from the first address that has them, checked
//! against the catalog.

use std::fs;
use std::io::{self, ErrorKind, Read};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Error, anyhow};
use quad_dataset::NamedDataset;
use quad_dataset::benchmarks::Format;
use quad_run::files;
use quad_runtime::{Hint, ProgressBar, hinted};
use sha2::{Digest, Sha256};
use ureq::Agent;

use super::transfer::{Failure, Partial, client, transfer};

#[cfg(test)]
mod tests;

/// Attempts at one address without progress.
const ATTEMPTS: u32 = 4;

#[derive(Clone, Debug, PartialEq)]
pub struct LocalDataset {
    /// The file, or the folder of a Minari dataset.
    pub path: PathBuf,
    /// SHA-256 of the file, or of the folder's `main_data.hdf5`.
    pub sha256: String,
}

pub struct Fetcher {
    client: Agent,
    /// Pause between two attempts.
    pause: Duration,
    mirror: Option<String>,
}

impl Fetcher {
    /// `mirror` is the address of a folder that is tried before the catalog's.
    pub fn new(mirror: Option<String>) -> Self {
        Self { client: client(Duration::from_secs(30)), pause: Duration::from_secs(2), mirror }
    }

    /// Verifies the dataset's file in `folder`, or fetches it.
    pub fn fetch(&self, dataset: &NamedDataset, folder: &Path) -> anyhow::Result<LocalDataset> {
        let path = folder.join(&dataset.file);
        let local = |error| local(error, dataset, folder);
        match verify(dataset, &path) {
            Ok(Ok(sha256)) => return Ok(LocalDataset { path, sha256 }),
            Ok(Err(mismatch)) => {
                let (path, name) = (path.display(), &dataset.name);
                return Err(anyhow!("{path} is not the dataset {name}: {mismatch}"))
                    .hint("remove it or move it away, and it will be fetched anew");
            }
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => return Err(local(error)),
        }
        fs::create_dir_all(folder).map_err(local)?;
        let mut partial = Partial::open(&path).map_err(local)?;
        let progress = ProgressBar::bytes();
        let mut refusals = String::new();
        for address in self.addresses(dataset) {
            let shown = without_password(&address);
            progress.say(&format!("fetching {} from {shown}", dataset.name));
            match self.fetch_from(&address, dataset, &mut partial, &progress) {
                Ok(sha256) => {
                    partial.finish(&path).map_err(local)?;
                    let checksum = dataset.sha256.as_ref().map_or("", |_| " and checksum");
                    progress.say(&format!("{}: size{checksum} verified", path.display()));
                    return Ok(LocalDataset { path, sha256 });
                }
                Err(Failure::Local(error)) => return Err(local(error)),
                Err(Failure::Passing(reason) | Failure::Lasting(reason)) => {
                    progress.say(&reason);
                    refusals += &format!("\n  {shown}: {reason}");
                }
            }
        }
        let (name, path) = (&dataset.name, path.display());
        Err(anyhow!("no address has the dataset {name}{refusals}")).hint(format!(
            "fetch the file elsewhere and put it at {path}, or name a mirror by QUAD_DATASETS_URL=http://HOST/FOLDER"
        ))
    }

    fn addresses(&self, dataset: &NamedDataset) -> Vec<String> {
        let file = |base: &String| format!("{}/{}", base.trim_end_matches('/'), dataset.file);
        let mirror = self.mirror.iter().map(file);
        mirror.chain(dataset.addresses.iter().cloned()).collect()
    }

    /// Fetches the whole file from one address, as long as attempts make progress. Returns its
    /// SHA-256.
    fn fetch_from(
        &self,
        address: &str,
        dataset: &NamedDataset,
        partial: &mut Partial,
        progress: &ProgressBar,
    ) -> Result<String, Failure> {
        // Without its size, an earlier part may be of another file.
        if dataset.bytes.is_none_or(|bytes| partial.length > bytes) {
            partial.clear()?;
        }
        let (mut furthest, mut attempts) = (partial.length, ATTEMPTS);
        loop {
            let result = match dataset.bytes {
                Some(bytes) if bytes == partial.length => Ok(()),
                bytes => transfer(&self.client, address, bytes, partial, progress),
            };
            attempts -= 1;
            if partial.length > furthest {
                (furthest, attempts) = (partial.length, ATTEMPTS);
            }
            match result.and_then(|()| check(dataset, partial)) {
                Err(Failure::Passing(reason)) if attempts > 0 => {
                    progress.say(&format!("{reason}; trying again"));
                }
                ended => return ended,
            }
            std::thread::sleep(self.pause);
        }
    }
}

/// An address to be shown, without what stands before an `@`: a user's name and password.
fn without_password(address: &str) -> String {
    match (address.rsplit_once('@'), address.split_once("://")) {
        (None, _) => address.to_owned(),
        (Some((_, host)), Some((scheme, _))) => format!("{scheme}://…@{host}"),
        (Some((_, host)), None) => format!("…@{host}"),
    }
}

/// SHA-256 of the fetched file, which is deleted if it is not the dataset's.
fn check(dataset: &NamedDataset, partial: &mut Partial) -> Result<String, Failure> {
    verify(dataset, &partial.path)?.or_else(|mismatch| {
        partial.clear()?;
        let reason = format!("what came is not the file and is deleted: {mismatch}");
        Err(Failure::Lasting(reason))
    })
}

fn local(error: io::Error, dataset: &NamedDataset, folder: &Path) -> Error {
    let hint = match (&dataset.benchmark.cache.variable, error.kind()) {
        (None, _) => {
            "make the folder a link to one that you may write to and that has room".to_owned()
        }
        (Some(variable), ErrorKind::StorageFull | ErrorKind::QuotaExceeded) => format!(
            "make room, or name a folder on another disk in {variable}; what has arrived is kept and will be continued"
        ),
        (Some(variable), _) => format!("name a folder that you may write to in {variable}"),
    };
    let (name, folder) = (&dataset.name, folder.display());
    let text = format!("cannot keep the dataset {name} in {folder}");
    hinted(Error::new(error).context(text), hint)
}

/// SHA-256 of a file in lower-case hexadecimal if size, format and checksum are those of the
/// catalog; otherwise the mismatch.
fn verify(dataset: &NamedDataset, path: &Path) -> io::Result<Result<String, String>> {
    let mut file = files::open_named(path)?;
    let bytes = file.metadata()?.len();
    if let Some(expected) = dataset.bytes.filter(|expected| *expected != bytes) {
        return Ok(Err(format!("it has {bytes} bytes, but must have {expected}")));
    }
    let mut start = Vec::new();
    let format = dataset.benchmark.format;
    file.by_ref().take(16).read_to_end(&mut start)?;
    // Some servers send a web page instead of an error.
    if Format::from_start(&start) != Some(format) {
        return Ok(Err(format!("it is not an {}", format.name())));
    }
    let sha256 = sha256(path)?;
    Ok(match &dataset.sha256 {
        Some(expected) if *expected != sha256 => {
            Err(format!("its SHA-256 is {sha256}, but must be {expected}"))
        }
        _ => Ok(sha256),
    })
}

/// SHA-256 of a file in lower-case hexadecimal.
pub fn sha256(path: &Path) -> io::Result<String> {
    let mut file = files::open_named(path)?;
    let mut hasher = Sha256::new();
    io::copy(&mut file, &mut hasher)?;
    Ok(format!("{:x}", hasher.finalize()))
}
