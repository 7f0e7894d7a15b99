//! Files of the catalog, from the cache folder or from the first address that has them.

use std::fs;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Error, anyhow};
use quad_dataset::NamedDataset;
use quad_runtime::{Hint, ProgressBar, hinted};
use ureq::Agent;

use super::partial::Partial;
use super::transfer::{Failure, client, transfer};
use super::verify::verify;

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
            let failure = match result.and_then(|()| check(dataset, partial)) {
                Ok(sha256) => return Ok(sha256),
                Err(failure) => failure,
            };
            attempts -= 1;
            if partial.length > furthest {
                (furthest, attempts) = (partial.length, ATTEMPTS);
            }
            match failure {
                Failure::Passing(reason) if attempts > 0 => {
                    progress.say(&format!("{reason}; trying again"))
                }
                failure => return Err(failure),
            }
            std::thread::sleep(self.pause);
        }
    }
}

/// An address to be shown, without what stands before an `@`: a user's name and password.
fn without_password(address: &str) -> String {
    let Some((before, host)) = address.rsplit_once('@') else { return address.to_owned() };
    let scheme =
        before.split_once("://").map_or(String::new(), |(scheme, _)| scheme.to_owned() + "://");
    format!("{scheme}…@{host}")
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
