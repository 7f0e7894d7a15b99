//! What `--dataset` means: a path, a name of the catalogue, or `minari:` and an ID.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use quad_dataset::{DatasetError, NamedDataset, catalogue, environment};
use quad_service::Hint;

use super::cache;
use super::fetch::{Fetcher, LocalDataset};
use super::verify::sha256;
use crate::config::did_you_mean;

/// A lab's own mirror: the address of a folder that is tried before the catalogue's.
const MIRROR: &str = "QUAD_DATASETS_URL";
/// What names a dataset of Minari's begin with.
const MINARI: &str = "minari:";

/// Where a run's data comes from.
#[derive(Clone, Debug, PartialEq)]
pub enum Source {
    /// A file of the catalogue, in D4RL's cache folder or fetched into it.
    Named(&'static NamedDataset),
    /// A dataset that Minari's own client has fetched, by its ID.
    Minari(String),
    /// A file or folder.
    Path(PathBuf),
}

impl Source {
    /// Understands what was typed. A name of the catalogue comes before a file of that name; `./NAME` is the file.
    pub fn parse(text: &str) -> anyhow::Result<Self> {
        if let Some(id) = text.strip_prefix(MINARI) {
            return Ok(Self::Minari(id.to_owned()));
        }
        let path = Path::new(text);
        let is_path = path.exists() || text.contains('/') || path.extension().is_some();
        match Self::named(text) {
            Err(_) if is_path => Ok(Self::Path(path.to_owned())),
            named => named,
        }
    }

    /// The catalogue's dataset of that name.
    pub fn named(name: &str) -> anyhow::Result<Self> {
        const LIST: &str = "`learner datasets list` prints all names; to train on a file, give its path";
        let known = catalogue::all().iter().map(|dataset| dataset.name.as_str());
        let nearest = did_you_mean(name, known).map(|nearest| nearest + " ").unwrap_or_default();
        let found = catalogue::find(name).map(Self::Named);
        found.ok_or_else(|| anyhow!("unknown dataset `{name}`")).hint(nearest + LIST)
    }

    /// The entry of the catalogue, for a path by the file's name.
    pub fn entry(&self) -> Option<&'static NamedDataset> {
        match self {
            Self::Named(dataset) => Some(dataset),
            Self::Minari(_) => None,
            Self::Path(path) => catalogue::find_file(path.file_name()?.to_str()?),
        }
    }

    /// Refuses data that the catalogue says is from another simulation than that of `environment`.
    pub fn check_environment(&self, environment: &str) -> anyhow::Result<()> {
        let simulation =
            |name: &'_ str| environment::find(name).map_or(name.to_owned(), |spec| spec.simulation().to_owned());
        match self.entry() {
            Some(entry) if simulation(&entry.environment) != simulation(environment) => Err(anyhow!(
                "{} is a dataset of {}, but the policy is for {environment}",
                entry.name,
                entry.environment
            ))
            .hint("choose a preset of the dataset's environment, or another --dataset"),
            _ => Ok(()),
        }
    }

    /// Finds it on this machine, or fetches it; its checksum is computed in any case.
    pub fn obtain(&self) -> anyhow::Result<LocalDataset> {
        match self {
            Self::Named(dataset) => {
                let mirror = std::env::var(MIRROR).ok().filter(|mirror| !mirror.is_empty());
                Fetcher::new(mirror).fetch(dataset, &cache::folder()?)
            }
            Self::Minari(id) => {
                let path = quad_dataset::minari_folder(id);
                if !path.exists() {
                    return Err(anyhow!("the dataset {MINARI}{id} is not in {}", path.display())).hint(format!(
                        "fetch it by Minari's own client: pip install minari, then: minari download {id}"
                    ));
                }
                local(path)
            }
            Self::Path(path) => local(path.clone()),
        }
    }
}

fn local(path: PathBuf) -> anyhow::Result<LocalDataset> {
    let data = quad_dataset::data_file(&path).hint_of(DatasetError::hint)?;
    let sha256 = sha256(&data).with_context(|| format!("cannot read {}", data.display()))?;
    Ok(LocalDataset { path, sha256 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{presets, resolve};

    #[test]
    fn a_word_is_a_name_a_path_or_neither() {
        let named = Source::parse("walker2d-medium-replay-v2").unwrap();
        assert_eq!(named.entry().unwrap().file, "walker2d_medium-replay-v2.hdf5");
        assert_eq!(Source::parse("minari:a/b-v0").unwrap(), Source::Minari("a/b-v0".to_owned()));
        for path in ["data/missing.hdf5", "missing.npz", "./hopper-medium-v2", "/tmp"] {
            assert_eq!(Source::parse(path).unwrap(), Source::Path(path.into()));
        }
        let error = Source::parse("quadruped").unwrap_err().to_string();
        assert_eq!(error, "unknown dataset `quadruped`");
    }

    #[test]
    fn the_presets_datasets_are_known_and_of_their_environments() {
        let resolved = presets::names().filter_map(|name| resolve(name, &toml::Table::new()).ok());
        let named: Vec<_> = resolved.filter(|experiment| experiment.dataset.is_some()).collect();
        assert_eq!(named.len(), 15, "the rows of the paper's table");
        for experiment in named {
            let source = Source::parse(&experiment.dataset.unwrap()).unwrap();
            assert!(matches!(source, Source::Named(_)), "{source:?}");
            source.check_environment(&experiment.environment).unwrap();
        }
    }

    #[test]
    fn data_of_another_simulation_is_refused() {
        for (source, environment, fits) in [
            ("hopper-medium-v2", "hopper", true),
            ("hopper-medium-v2", "walker2d", false),
            ("hopper-medium-v2", "my-robot", false),
            // The goal of v0 and v2 is another one, not the maze.
            ("antmaze-umaze-v2", "antmaze-umaze-v0", true),
            ("antmaze-medium-play-v0", "antmaze-umaze", false),
            // By the name of the file alone.
            ("data/hopper_medium-v2.hdf5", "walker2d", false),
            ("data/mine.hdf5", "walker2d", true),
        ] {
            let checked = Source::parse(source).unwrap().check_environment(environment);
            assert_eq!(checked.is_ok(), fits, "{source} for {environment}: {checked:?}");
        }
    }

    #[test]
    fn what_is_not_there_is_named() {
        for source in ["minari:no/such-v0", "nowhere/x.hdf5"] {
            let error = format!("{:#}", Source::parse(source).unwrap().obtain().unwrap_err());
            assert!(error.contains(source), "{error}");
        }
    }

    #[test]
    fn the_checksum_of_a_folder_is_that_of_its_data() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("main_data.hdf5"), "abc").unwrap();
        let source = Source::Path(folder.path().to_owned());
        // FIPS 180-2, B.1.
        let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(source.obtain().unwrap().sha256, abc);
    }
}
