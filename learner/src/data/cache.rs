//! The cache folders of benchmarks, shared with their Python packages.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use indicatif::HumanBytes;
use quad_dataset::benchmarks::{Benchmark, Cache};
use quad_dataset::{NamedDataset, catalog};
use quad_runtime::Hint;

use super::partial::partial_files;

pub fn folder(benchmark: &Benchmark) -> anyhow::Result<PathBuf> {
    let Cache { folder, variable } = &benchmark.cache;
    let named = variable.as_ref().and_then(std::env::var_os);
    if let Some(named) = named.filter(|named| !named.is_empty()) {
        return Ok(named.into());
    }
    let hint = match variable {
        Some(variable) => format!("name a folder in {variable}"),
        None => "name a home folder in HOME".to_owned(),
    };
    let home = std::env::home_dir().filter(|home| !home.as_os_str().is_empty());
    home.map(|home| home.join(folder))
        .ok_or_else(|| anyhow!("there is no home folder to keep datasets in"))
        .hint(hint)
}

/// The catalog: name, environment, size, and state of the file in its folder. Does not compute
/// checksums.
pub fn list() -> impl Iterator<Item = anyhow::Result<[String; 4]>> {
    catalog::all().iter().map(|dataset| {
        let size = dataset.bytes.map(|bytes| HumanBytes(bytes).to_string());
        let path = folder(dataset.benchmark)?.join(&dataset.file);
        let (size, state) = (size.unwrap_or("unknown".to_owned()), state(dataset, &path));
        Ok([dataset.name.clone(), dataset.environment.clone(), size, state])
    })
}

fn state(dataset: &NamedDataset, path: &Path) -> String {
    let found = path.metadata().map(|metadata| metadata.len());
    let parts = partial_files(path).into_iter();
    match (found, parts.map(|(_, length)| length).max()) {
        (Ok(found), _) if dataset.bytes.is_some_and(|bytes| bytes != found) => {
            format!("another file of {found} bytes")
        }
        (Ok(_), _) => "yes".to_owned(),
        (Err(_), Some(part)) => format!("{} of it", HumanBytes(part)),
        (Err(_), None) => "no".to_owned(),
    }
}
