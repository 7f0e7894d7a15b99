//! The datasets that can be asked for by name: the table `datasets.toml`, and OGBench's.

use std::sync::LazyLock;

use serde::Deserialize;

use crate::{hdf5_file, npz_file, ogbench};

/// A file that can be fetched, and what it must be.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NamedDataset {
    /// Its benchmark's name for it, e.g. `hopper-medium-v2`.
    pub name: String,
    /// The environment that it was recorded in.
    pub environment: String,
    /// Its benchmark's name of the file.
    pub file: String,
    /// Size in bytes, if it is known.
    pub bytes: Option<u64>,
    /// SHA-256 in lower-case hexadecimal, if it is known.
    pub sha256: Option<String>,
    /// License of the data, which a collection shares.
    #[serde(skip)]
    pub license: String,
    /// Where it can be had, best first: the file in each folder of its collection.
    #[serde(skip)]
    pub addresses: Vec<String>,
}

impl NamedDataset {
    /// Whether it is OGBench's, which has npz files in a folder of its own; the others are D4RL's
    /// HDF5.
    pub fn is_ogbench(&self) -> bool {
        self.file.ends_with(".npz")
    }

    /// The first bytes of its file, and what people call such a file.
    pub fn format(&self) -> (&'static [u8], &'static str) {
        if self.is_ogbench() {
            (npz_file::SIGNATURE, "npz archive")
        } else {
            (hdf5_file::SIGNATURE, "HDF5 file")
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    collection: Vec<Collection>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Collection {
    license: String,
    folders: Vec<String>,
    dataset: Vec<NamedDataset>,
}

impl Collection {
    fn into_datasets(self) -> impl Iterator<Item = NamedDataset> {
        let Self { license, folders, dataset } = self;
        dataset.into_iter().map(move |dataset| {
            let addresses =
                folders.iter().map(|folder| format!("{folder}{}", dataset.file)).collect();
            NamedDataset { addresses, license: license.clone(), ..dataset }
        })
    }
}

#[allow(clippy::expect_used)] // The table is part of the program; the first test here reads it.
static DATASETS: LazyLock<Vec<NamedDataset>> = LazyLock::new(|| {
    let table: Table =
        toml::from_str(include_str!("../datasets.toml")).expect("the embedded table is valid");
    table
        .collection
        .into_iter()
        .flat_map(Collection::into_datasets)
        .chain(ogbench::files())
        .collect()
});

/// All datasets.
pub fn all() -> &'static [NamedDataset] {
    &DATASETS
}

/// The dataset of that name.
pub fn find(name: &str) -> Option<&'static NamedDataset> {
    all().iter().find(|dataset| dataset.name == name)
}

/// The dataset whose file has that name, in whatever folder.
pub fn find_file(file: &str) -> Option<&'static NamedDataset> {
    all().iter().find(|dataset| dataset.file == file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::environment;

    #[test]
    fn the_table_is_consistent() {
        for dataset in all().iter().filter(|dataset| !dataset.is_ogbench()) {
            let NamedDataset { name, file, sha256, addresses, .. } = dataset;
            assert_eq!(
                (find(name), find_file(file)),
                (Some(dataset), Some(dataset)),
                "names are unique"
            );
            let environment = environment::find(&dataset.environment).unwrap();
            assert!(name.starts_with(environment.simulation()), "{name}");
            assert!(
                addresses
                    .iter()
                    .all(|address| address.starts_with("http") && address.ends_with(file)),
                "{name}"
            );
            assert!(!addresses.is_empty() && dataset.license == "CC BY 4.0", "{name}");
            let is_digest = |text: &String| {
                text.len() == 64 && text.chars().all(|digit| matches!(digit, '0'..='9' | 'a'..='f'))
            };
            assert!(sha256.as_ref().is_none_or(is_digest), "{name}: {sha256:?}");
            assert!(sha256.is_none() || dataset.bytes.is_some(), "{name}");
        }
    }
}
