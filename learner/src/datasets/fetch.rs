//! A file of the catalogue: from the cache folder, or from the first address that has it.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use backon::{BackoffBuilder, ExponentialBuilder};
use quad_dataset::NamedDataset;
use ureq::Agent;

use super::partial::Partial;
use super::progress::Progress;
use super::transfer::{Patience, TransferError, client, transfer};
use super::verify::{Mismatch, verify};

#[cfg(test)]
mod tests;

/// A file that cannot be had.
#[derive(Debug, thiserror::Error)]
pub enum FetchError {
    /// Something else has the file's name.
    #[error("{} is not the dataset {name}: {mismatch}", .path.display())]
    Cached {
        /// The dataset.
        name: String,
        /// The file.
        path: PathBuf,
        /// How it differs.
        mismatch: Mismatch,
    },
    /// It cannot be read or written here.
    #[error("cannot keep the dataset {name} in {}", .folder.display())]
    Local {
        /// The dataset.
        name: String,
        /// The folder.
        folder: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// No address has it.
    #[error("no address has the dataset {name}{}", refusals.iter().map(|(address, error)| format!("\n  {address}: {error}")).collect::<String>())]
    Unavailable {
        /// The dataset.
        name: String,
        /// Where its file belongs.
        path: PathBuf,
        /// What was tried, in this order, and what came of it.
        refusals: Vec<(String, TransferError)>,
    },
}

impl FetchError {
    /// What to do about it.
    pub fn hint(&self) -> String {
        match self {
            Self::Cached { .. } => "remove it or move it away, and it will be fetched anew".to_owned(),
            Self::Local { source, .. } if source.kind() == io::ErrorKind::StorageFull => {
                "make room, or name a folder on another disk in D4RL_DATASET_DIR; what has arrived is kept and will be \
                 continued"
                    .to_owned()
            }
            Self::Local { .. } => "name a folder that you may write to in D4RL_DATASET_DIR".to_owned(),
            Self::Unavailable { path, .. } => format!(
                "fetch the file elsewhere and put it at {}, or name a mirror in QUAD_DATASETS_URL",
                path.display()
            ),
        }
    }
}

/// Fetches files.
pub struct Fetcher {
    client: Agent,
    delays: ExponentialBuilder,
    mirror: Option<String>,
}

impl Fetcher {
    /// `mirror` is the address of a folder that is tried before the catalogue's.
    pub fn new(mirror: Option<String>) -> Self {
        let patience = Patience { connect: Duration::from_secs(10), silence: Duration::from_secs(30) };
        let delays = ExponentialBuilder::new().with_min_delay(Duration::from_secs(1)).with_max_times(3);
        Self { client: client(patience), delays, mirror }
    }

    /// The dataset's file under its own name in `folder`, verified: where it is and its SHA-256.
    pub fn fetch(&self, dataset: &NamedDataset, folder: &Path) -> Result<(PathBuf, String), FetchError> {
        let path = folder.join(&dataset.file);
        let local = |source| FetchError::Local { name: dataset.name.clone(), folder: folder.to_owned(), source };
        if let Some(sha256) = cached(dataset, &path)? {
            return Ok((path, sha256));
        }
        fs::create_dir_all(folder).map_err(local)?;
        let mut partial = Partial::open(&path).map_err(local)?;
        // Another process may have completed it, while this one waited for it to do so.
        if let Some(sha256) = cached(dataset, &path)? {
            partial.discard().map_err(local)?;
            return Ok((path, sha256));
        }
        let progress = Progress::new();
        let mut refusals = Vec::new();
        for address in self.addresses(dataset) {
            progress.say(&format!("fetching {} from {address}", dataset.name));
            match self.fetch_from(&address, dataset, &mut partial, &progress) {
                Ok(sha256) => {
                    partial.finish(&path).map_err(local)?;
                    progress.say(&format!("{}: size and {} verified", path.display(), dataset.sha256.known()));
                    return Ok((path, sha256));
                }
                Err(TransferError::Local(source)) => return Err(local(source)),
                Err(error) => refusals.push((address, error)),
            }
        }
        if partial.len() == 0 {
            partial.discard().map_err(local)?;
        }
        Err(FetchError::Unavailable { name: dataset.name.clone(), path, refusals })
    }

    fn addresses(&self, dataset: &NamedDataset) -> Vec<String> {
        let mirror = self.mirror.iter().map(|base| format!("{}/{}", base.trim_end_matches('/'), dataset.file));
        mirror.chain(dataset.addresses.iter().cloned()).collect()
    }

    /// The whole file from one address, by as many attempts as bring it forward; its SHA-256.
    fn fetch_from(
        &self,
        address: &str,
        dataset: &NamedDataset,
        partial: &mut Partial,
        progress: &Progress,
    ) -> Result<String, TransferError> {
        partial.change_address();
        // Only a size and a checksum can tell whether what is here already belongs to the file.
        if dataset.bytes.is_none_or(|bytes| partial.len() > bytes) {
            partial.clear()?;
        }
        let mut delays = self.delays.build();
        let mut furthest = partial.len();
        loop {
            let result = match dataset.bytes {
                Some(bytes) if bytes == partial.len() => Ok(()),
                bytes => transfer(&self.client, address, bytes, partial, progress),
            };
            let mixed = partial.is_mixed();
            let error = match result.and_then(|()| check(dataset, partial)) {
                Ok(sha256) => return Ok(sha256),
                Err(error) => error,
            };
            if mixed && matches!(error, TransferError::Mismatch(_)) {
                progress.say(&format!("{error}; starting again without what was kept of an earlier attempt"));
                continue;
            }
            // As long as it goes forward, however slowly, it is worth going on.
            if partial.len() > furthest {
                furthest = partial.len();
                delays = self.delays.build();
            }
            let Some(delay) = delays.next().filter(|_| error.is_transient()) else {
                progress.say(&error.to_string());
                return Err(error);
            };
            progress.say(&format!("{error}; trying again"));
            std::thread::sleep(delay);
        }
    }
}

/// SHA-256 of what has arrived, if it is the dataset's file; otherwise it is deleted.
fn check(dataset: &NamedDataset, partial: &mut Partial) -> Result<String, TransferError> {
    verify(dataset, partial.path())?.or_else(|mismatch| {
        partial.clear()?;
        Err(TransferError::Mismatch(mismatch))
    })
}

/// SHA-256 of the dataset's file if it is at `path`; an error if that is another file.
fn cached(dataset: &NamedDataset, path: &Path) -> Result<Option<String>, FetchError> {
    let name = || dataset.name.clone();
    match verify(dataset, path) {
        Ok(Ok(sha256)) => Ok(Some(sha256)),
        Ok(Err(mismatch)) => Err(FetchError::Cached { name: name(), path: path.to_owned(), mismatch }),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(source) => {
            let folder = path.parent().unwrap_or(path).to_owned();
            Err(FetchError::Local { name: name(), folder, source })
        }
    }
}
