//! Downloadable datasets: `datasets.toml`, and those named by rules of [`benchmarks`].

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde::Deserialize;

use super::benchmarks::{self, Benchmark, Host};

/// Downloadable dataset.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedDataset {
    /// Name in its benchmark, e.g. `hopper-medium-v2`.
    pub name: String,
    /// Benchmark of the dataset.
    pub benchmark: &'static Benchmark,
    /// Environment of the recording.
    pub environment: String,
    /// File name in its benchmark.
    pub file: String,
    /// Size in bytes, if known.
    pub bytes: Option<u64>,
    /// SHA-256 in lowercase hexadecimal, if known.
    pub sha256: Option<String>,
    /// License of the data.
    pub license: String,
    /// URLs in order of preference.
    pub addresses: Vec<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Collection {
    benchmark: String,
    license: String,
    folders: Vec<String>,
    dataset: Vec<Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    environment: String,
    file: String,
    bytes: Option<u64>,
    sha256: Option<String>,
}

impl Entry {
    fn hosted(
        self,
        benchmark: &'static Benchmark,
        license: &str,
        folders: &[String],
    ) -> NamedDataset {
        let address = |folder: &String| format!("{folder}{}", self.file);
        NamedDataset {
            benchmark,
            license: license.to_owned(),
            addresses: folders.iter().map(address).collect(),
            name: self.name,
            environment: self.environment,
            file: self.file,
            bytes: self.bytes,
            sha256: self.sha256,
        }
    }
}

#[allow(clippy::expect_used)] // The tables are part of the program; the first test here reads them.
static DATASETS: LazyLock<Vec<NamedDataset>> = LazyLock::new(|| {
    let table: BTreeMap<String, Vec<Collection>> =
        toml::from_str(include_str!("../../datasets.toml")).expect("the embedded table is valid");
    let listed = table.into_values().flatten().flat_map(|collection| {
        let benchmark = benchmarks::find(&collection.benchmark);
        let benchmark = benchmark.expect("a collection is of a benchmark");
        let entries = collection.dataset.into_iter();
        entries.map(move |entry| entry.hosted(benchmark, &collection.license, &collection.folders))
    });
    let named = benchmarks::tasks().filter(|task| task.is_default && task.maze.is_some());
    let named = named.filter_map(|task| {
        let Host { license, folders } = task.benchmark.host.as_ref()?;
        let entry = Entry {
            file: format!("{}.{}", task.dataset, task.benchmark.format.extension()),
            name: task.dataset,
            environment: task.environment,
            bytes: None,
            sha256: None,
        };
        Some(entry.hosted(task.benchmark, license, folders))
    });
    listed.chain(named).collect()
});

/// All datasets.
pub fn datasets() -> &'static [NamedDataset] {
    &DATASETS
}

/// Dataset of the given name.
pub fn find(name: &str) -> Option<&'static NamedDataset> {
    datasets().iter().find(|dataset| dataset.name == name)
}

/// Dataset with the given file name; folders are ignored.
pub fn find_file(file: &str) -> Option<&'static NamedDataset> {
    datasets().iter().find(|dataset| dataset.file == file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::environment::{self, simulation_name};

    #[test]
    fn the_table_is_consistent() {
        for dataset in datasets() {
            let (name, file) = (&dataset.name, &dataset.file);
            assert_eq!([find(name), find_file(file)], [Some(dataset); 2], "unique");
            let addresses = &dataset.addresses;
            assert!(!addresses.is_empty() && !dataset.license.is_empty(), "{name}");
            let is_address = |url: &String| url.starts_with("http") && url.ends_with(file);
            assert!(addresses.iter().all(is_address), "{name}");
            let is_digit = |digit| matches!(digit, '0'..='9' | 'a'..='f');
            let environment = &dataset.environment;
            if let Some(digest) = &dataset.sha256 {
                assert!(digest.len() == 64 && digest.chars().all(is_digit), "{name}");
                assert!(dataset.bytes.is_some(), "{name}");
                assert!(name.starts_with(&*simulation_name(environment)), "{name}");
            }
            let is_simulated = environment::find(environment).is_ok();
            let is_relabeled = benchmarks::relabeling(environment).is_some();
            assert!(is_simulated || is_relabeled, "{name}");
        }
        assert_eq!(datasets().len(), 54);
        let address =
            "https://rail.eecs.berkeley.edu/datasets/ogbench/antsoccer-medium-stitch-v0.npz";
        let stitch = find("antsoccer-medium-stitch-v0").unwrap();
        assert_eq!(stitch.addresses[1..], [address]);
    }
}
