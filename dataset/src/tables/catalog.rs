//! Downloadable datasets: `datasets.toml`, and those named by rules of [`benchmarks`].

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
struct Table {
    collection: Vec<Collection>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Collection {
    benchmark: String,
    license: String,
    folders: Vec<String>,
    dataset: Vec<Row>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    name: String,
    environment: String,
    file: String,
    bytes: Option<u64>,
    sha256: Option<String>,
}

impl Row {
    fn hosted(
        self,
        benchmark: &'static Benchmark,
        Host { license, folders }: &Host,
    ) -> NamedDataset {
        let Self { name, environment, file, bytes, sha256 } = self;
        let addresses = folders.iter().map(|folder| format!("{folder}{file}")).collect();
        let license = license.clone();
        NamedDataset { name, benchmark, environment, file, bytes, sha256, license, addresses }
    }
}

#[allow(clippy::expect_used)] // The tables are part of the program; the first test here reads them.
static DATASETS: LazyLock<Vec<NamedDataset>> = LazyLock::new(|| {
    let table: Table =
        toml::from_str(include_str!("../../datasets.toml")).expect("the embedded table is valid");
    let listed = table.collection.into_iter().flat_map(
        |Collection { benchmark, license, folders, dataset }| {
            let benchmark = benchmarks::find(&benchmark).expect("a collection is of a benchmark");
            let host = Host { license, folders };
            dataset.into_iter().map(move |row| row.hosted(benchmark, &host))
        },
    );
    let named = benchmarks::tasks().filter(|task| task.is_default && task.maze.is_some());
    let named = named.filter_map(|task| {
        let (name, environment) = (task.dataset, task.environment);
        let file = format!("{name}.{}", task.benchmark.format.extension());
        let row = Row { name, environment, file, bytes: None, sha256: None };
        Some(row.hosted(task.benchmark, task.benchmark.host.as_ref()?))
    });
    listed.chain(named).collect()
});

/// All datasets.
pub fn all() -> &'static [NamedDataset] {
    &DATASETS
}

/// Dataset of the given name.
pub fn find(name: &str) -> Option<&'static NamedDataset> {
    all().iter().find(|dataset| dataset.name == name)
}

/// Dataset with the given file name; folders are ignored.
pub fn find_file(file: &str) -> Option<&'static NamedDataset> {
    all().iter().find(|dataset| dataset.file == file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::environment::{self, simulation_of};

    #[test]
    fn the_table_is_consistent() {
        for dataset in all() {
            let NamedDataset { name, file, sha256, addresses, .. } = dataset;
            let found = (find(name), find_file(file));
            assert_eq!(found, (Some(dataset), Some(dataset)), "names are unique");
            assert!(!addresses.is_empty() && !dataset.license.is_empty(), "{name}");
            let is_address = |url: &String| url.starts_with("http") && url.ends_with(file);
            assert!(addresses.iter().all(is_address), "{name}");
            let is_digit = |digit| matches!(digit, '0'..='9' | 'a'..='f');
            let is_digest = |text: &String| text.len() == 64 && text.chars().all(is_digit);
            assert!(sha256.as_ref().is_none_or(is_digest), "{name}: {sha256:?}");
            assert!(sha256.is_none() || dataset.bytes.is_some(), "{name}");
            let is_simulated = environment::find(&dataset.environment).is_ok();
            assert!(
                is_simulated || benchmarks::relabeling(&dataset.environment).is_some(),
                "{name}"
            );
            assert!(
                name.starts_with(&*simulation_of(&dataset.environment)) || sha256.is_none(),
                "{name}"
            );
        }
        assert_eq!(all().len(), 54);
        let address =
            "https://rail.eecs.berkeley.edu/datasets/ogbench/antsoccer-medium-stitch-v0.npz";
        assert_eq!(find("antsoccer-medium-stitch-v0").unwrap().addresses, [address]);
    }
}
