//! The folders in which D4RL and OGBench keep their files, shared with everything else that uses
//! these.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use indicatif::HumanBytes;
use quad_dataset::{NamedDataset, catalog};
use quad_runtime::Hint;

use super::partial::left_of;

/// The environment variable that names another folder than the one in the home folder; D4RL's.
const VARIABLE: &str = "D4RL_DATASET_DIR";

/// Where D4RL keeps its files.
pub fn d4rl() -> anyhow::Result<PathBuf> {
    match std::env::var_os(VARIABLE).filter(|folder| !folder.is_empty()) {
        Some(folder) => Ok(folder.into()),
        None => in_home(".d4rl/datasets").hint(format!("name a folder in {VARIABLE}")),
    }
}

/// Where OGBench keeps its files.
pub fn ogbench() -> anyhow::Result<PathBuf> {
    in_home(".ogbench/data").hint("name a home folder in HOME")
}

/// Where a dataset belongs.
pub fn of(dataset: &NamedDataset) -> anyhow::Result<PathBuf> {
    if dataset.is_ogbench() { ogbench() } else { d4rl() }
}

fn in_home(folder: &str) -> anyhow::Result<PathBuf> {
    let home = std::env::home_dir().filter(|home| !home.as_os_str().is_empty());
    home.map(|home| home.join(folder))
        .ok_or_else(|| anyhow!("there is no home folder to keep datasets in"))
}

/// The catalog: name, environment, size, and what of it is in its folder already. Checksums are not
/// computed for this.
pub fn list() -> impl Iterator<Item = anyhow::Result<[String; 4]>> {
    catalog::all().iter().map(|dataset| {
        let size =
            dataset.bytes.map_or("unknown".to_owned(), |bytes| HumanBytes(bytes).to_string());
        let path = of(dataset)?.join(&dataset.file);
        Ok([dataset.name.clone(), dataset.environment.clone(), size, state(dataset, &path)])
    })
}

fn state(dataset: &NamedDataset, path: &Path) -> String {
    let found = path.metadata().map(|metadata| metadata.len());
    let part = left_of(path).into_iter().map(|(_, length)| length).max();
    match (found, part) {
        (Ok(found), _) if dataset.bytes.is_some_and(|bytes| bytes != found) => {
            format!("another file of {found} bytes")
        }
        (Ok(_), _) => "yes".to_owned(),
        (Err(_), Some(part)) => format!("{} of it", HumanBytes(part)),
        (Err(_), None) => "no".to_owned(),
    }
}
