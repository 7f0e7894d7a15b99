//! The datasets that can be asked for by name: the table `datasets.toml`.

use std::sync::LazyLock;

use serde::Deserialize;

/// Hexadecimal digits of a SHA-256.
const SHA256_DIGITS: usize = 64;

/// A file that can be fetched, and what it must be.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedDataset {
    /// D4RL's name, e.g. `hopper-medium-v2`.
    pub name: String,
    /// The environment that it was recorded in.
    pub environment: String,
    /// D4RL's name of the file.
    pub file: String,
    /// Size in bytes, if it is known.
    pub bytes: Option<u64>,
    /// What is known of its checksum.
    pub sha256: Checksum,
    /// Licence of the data.
    pub licence: String,
    /// Where it can be had, best first.
    pub addresses: Vec<String>,
}

/// What is known of a SHA-256: all its digits, the first ones, the first and the last ones, or nothing.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(from = "String")]
pub struct Checksum {
    start: String,
    end: String,
}

impl From<String> for Checksum {
    /// Lower-case hexadecimal digits; an ellipsis stands for those between the first and the last ones.
    fn from(digits: String) -> Self {
        let (start, end) = digits.split_once('…').unwrap_or((&digits, ""));
        Self { start: start.to_owned(), end: end.to_owned() }
    }
}

impl Checksum {
    /// Whether a file of this SHA-256 (lower-case hexadecimal) can be the one.
    pub fn matches(&self, sha256: &str) -> bool {
        sha256.starts_with(&self.start) && sha256.ends_with(&self.end)
    }

    /// How much of it is known, for people.
    pub fn known(&self) -> &'static str {
        match (self.start.len(), self.end.len()) {
            (SHA256_DIGITS, _) => "checksum",
            (0, 0) => "no checksum",
            (_, 0) => "start of the checksum",
            _ => "start and end of the checksum",
        }
    }
}

impl std::fmt::Display for Checksum {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.start)?;
        if self.start.len() < SHA256_DIGITS { write!(f, "…{}", self.end) } else { Ok(()) }
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
    licence: String,
    folders: Vec<String>,
    dataset: Vec<Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    environment: String,
    file: String,
    #[serde(default)]
    bytes: Option<u64>,
    #[serde(default)]
    sha256: Checksum,
}

impl Collection {
    fn into_datasets(self) -> impl Iterator<Item = NamedDataset> {
        self.dataset.into_iter().map(move |Entry { name, environment, file, bytes, sha256 }| NamedDataset {
            addresses: self.folders.iter().map(|folder| format!("{folder}{file}")).collect(),
            licence: self.licence.clone(),
            name,
            environment,
            file,
            bytes,
            sha256,
        })
    }
}

#[allow(clippy::expect_used)] // The table is part of the program; the first test here reads it.
static DATASETS: LazyLock<Vec<NamedDataset>> = LazyLock::new(|| {
    let table: Table = toml::from_str(include_str!("../datasets.toml")).expect("the embedded table is valid");
    table.collection.into_iter().flat_map(Collection::into_datasets).collect()
});

/// All datasets of the table.
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
        for dataset in all() {
            let NamedDataset { name, file, sha256, addresses, .. } = dataset;
            assert_eq!((find(name), find_file(file)), (Some(dataset), Some(dataset)), "names are unique");
            let environment = environment::find(&dataset.environment).unwrap();
            assert!(name.starts_with(environment.simulation()), "{name}");
            assert!(addresses.iter().all(|address| address.starts_with("http") && address.ends_with(file)), "{name}");
            assert!(!addresses.is_empty() && dataset.licence == "CC BY 4.0", "{name}");
            let digits = format!("{}{}", sha256.start, sha256.end);
            assert!(digits.chars().all(|digit| matches!(digit, '0'..='9' | 'a'..='f')), "{name}: {digits}");
            assert!([0, 8, 17, 18, 64].contains(&digits.len()), "{name}: {} digits", digits.len());
            assert_eq!(digits.is_empty(), dataset.bytes.is_none(), "{name}");
        }
    }

    #[test]
    fn every_row_of_the_papers_first_table_can_be_verified() {
        for environment in ["hopper", "halfcheetah", "walker2d"] {
            for kind in ["medium", "medium-replay", "medium-expert"] {
                assert!(find(&format!("{environment}-{kind}-v2")).unwrap().bytes.is_some());
            }
        }
        for kind in ["umaze", "umaze-diverse", "medium-play", "medium-diverse", "large-play", "large-diverse"] {
            assert!(find(&format!("antmaze-{kind}-v0")).unwrap().bytes.is_some());
        }
    }

    #[test]
    fn a_checksum_matches_as_far_as_it_is_known() {
        let whole = "c771dd63".to_owned() + &"0".repeat(46) + "1d06e8c932";
        for (known, what) in [
            (whole.as_str(), "checksum"),
            ("c771dd63", "start of the checksum"),
            ("c771dd63…1d06e8c932", "start and end of the checksum"),
            ("", "no checksum"),
        ] {
            let checksum = Checksum::from(known.to_owned());
            assert!(checksum.matches(&whole), "{known}");
            assert_eq!(checksum.known(), what);
        }
        assert!(!Checksum::from("c771dd64".to_owned()).matches(&whole));
        assert!(!Checksum::from("c771dd63…1d06e8c933".to_owned()).matches(&whole));
        assert_eq!(Checksum::from("c771dd63".to_owned()).to_string(), "c771dd63…");
    }
}
