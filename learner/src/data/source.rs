//! Values of `--dataset`: a path, a name of the catalog, or `minari:` and an ID; and the cache folders
//! of benchmarks.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use indicatif::HumanBytes;
use quad_dataset::benchmarks::{Benchmark, Cache};
use quad_dataset::environment::{self, simulation_name};
use quad_dataset::{DatasetError, NamedDataset, catalog};
use quad_run::config::{did_you_mean, tasks};
use quad_runtime::Hint;

use super::fetch::{Fetcher, LocalDataset, sha256};
use super::transfer::partial_files;

/// Environment variable with the address of a mirror that is tried before the catalog's addresses.
const MIRROR: &str = "QUAD_DATASETS_URL";
const MINARI: &str = "minari:";

#[derive(Clone, Debug, PartialEq)]
pub enum Source {
    /// A file of the catalog, in its benchmark's cache folder or fetched into it.
    Named(&'static NamedDataset),
    /// A dataset that Minari's own client has fetched, by its ID.
    Minari(String),
    Path(PathBuf),
}

impl Source {
    /// Parses `--dataset`. A name of the catalog, or of a file that `learner datasets make` has made,
    /// comes before a file of that name; `./NAME` is the file.
    pub fn parse(text: &str) -> anyhow::Result<Self> {
        if let Some(id) = text.strip_prefix(MINARI) {
            return Ok(Self::Minari(id.to_owned()));
        }
        let path = Path::new(text);
        let made = || Some(made_folder().ok()?.join(format!("{text}.hdf5")));
        let is_path = path.exists() || text.contains('/') || path.extension().is_some();
        match Self::named(text) {
            Ok(named) => Ok(named),
            Err(error) => match made().filter(|made| made.exists()) {
                Some(made) => Ok(Self::Path(made)),
                None if is_path => Ok(Self::Path(path.to_owned())),
                None => Err(error),
            },
        }
    }

    /// [Parses](Self::parse) the names of a dataset's files.
    pub fn parse_all(names: &[String]) -> anyhow::Result<Vec<Self>> {
        names.iter().map(|name| Self::parse(name)).collect()
    }

    pub fn named(name: &str) -> anyhow::Result<Self> {
        const LIST: &str =
            "`learner datasets list` prints all names; to train on a file, give its path";
        let names = catalog::datasets().iter().map(|dataset| dataset.name.as_str());
        let hint = match tasks::named(name).map(|task| task.text("dataset")) {
            Ok(Some(dataset)) => format!("it is a task, whose dataset is {dataset}"),
            Ok(None) => {
                format!("it is a task: `learner train --task {name}` says how to make its data")
            }
            Err(_) => did_you_mean(name, names) + LIST,
        };
        let dataset = catalog::find(name).with_context(|| format!("unknown dataset `{name}`"));
        Ok(Self::Named(dataset.hint(hint)?))
    }

    /// The entry of the catalog, for a path by the file's name.
    pub fn entry(&self) -> Option<&'static NamedDataset> {
        match self {
            Self::Named(dataset) => Some(dataset),
            Self::Minari(_) => None,
            Self::Path(path) => catalog::find_file(path.file_name()?.to_str()?),
        }
    }

    /// Refuses data of another simulation than that of `environment`.
    pub fn check_environment(&self, environment: &str) -> anyhow::Result<()> {
        let Some(NamedDataset { name, environment: other, .. }) = self.entry() else {
            return Ok(());
        };
        if simulation_name(other) == simulation_name(environment) {
            return Ok(());
        }
        Err(anyhow!("{name} is a dataset of {other}, but the policy is for {environment}"))
            .hint("choose a task in the dataset's environment, or another --dataset")
    }

    /// A warning if neither catalog nor file names the environment, and another one has its sizes.
    pub fn doubt(&self, path: &Path, environment: &str) -> Option<String> {
        let spec = environment::find(environment).ok().filter(|_| self.entry().is_none())?;
        let named = quad_dataset::recorded_environment(path).ok()?;
        let other = &spec.same_sized().filter(|_| named.is_none())?.name;
        let path = path.display();
        Some(format!(
            "{path} names no environment: it is taken for {environment}'s, but {other} has the same sizes"
        ))
    }

    /// Finds the data on this machine, or fetches it, and computes its checksum.
    pub fn obtain(&self) -> anyhow::Result<LocalDataset> {
        match self {
            Self::Named(dataset) => {
                let mirror = std::env::var(MIRROR).ok();
                let fetcher = Fetcher::new(mirror.filter(|mirror| !mirror.is_empty()));
                fetcher.fetch(dataset, &cache_folder(dataset.benchmark)?)
            }
            Self::Minari(id) => {
                let path = quad_dataset::minari_folder(id);
                if !path.exists() {
                    let hint = format!(
                        "fetch it by Minari's own client: pip install minari, then: minari download {id}"
                    );
                    let path = path.display();
                    return Err(anyhow!("the dataset {MINARI}{id} is not in {path}")).hint(hint);
                }
                local(path)
            }
            Self::Path(path) => local(path.clone()),
        }
    }
}

/// [Obtains](Source::obtain) the files of a dataset: their paths and hashes.
pub fn obtain(sources: &[Source]) -> anyhow::Result<(Vec<PathBuf>, Vec<String>)> {
    let files = sources.iter().map(Source::obtain);
    files.map(|file| file.map(|LocalDataset { path, sha256 }| (path, sha256))).collect()
}

fn local(path: PathBuf) -> anyhow::Result<LocalDataset> {
    let data = quad_dataset::data_file(&path).hint_of(DatasetError::hint)?;
    let sha256 = sha256(&data).with_context(|| format!("cannot read {}", data.display()))?;
    Ok(LocalDataset { path, sha256 })
}

/// The cache folder of a benchmark, shared with its Python package.
pub fn cache_folder(benchmark: &Benchmark) -> anyhow::Result<PathBuf> {
    named_folder(&benchmark.cache)
}

/// The folder of the files that `learner datasets make` makes.
pub fn made_folder() -> anyhow::Result<PathBuf> {
    let variable = Some("QUAD_DATASETS_DIR".to_owned());
    named_folder(&Cache { folder: ".quad/datasets".to_owned(), variable })
}

fn named_folder(Cache { folder, variable }: &Cache) -> anyhow::Result<PathBuf> {
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
pub fn cached() -> impl Iterator<Item = anyhow::Result<[String; 4]>> {
    catalog::datasets().iter().map(|dataset| {
        let NamedDataset { name, environment, bytes, .. } = dataset;
        let path = cache_folder(dataset.benchmark)?.join(&dataset.file);
        let parts = partial_files(&path).into_iter().map(|(_, length)| length);
        let state = match (path.metadata().map(|file| file.len()), parts.max()) {
            (Ok(size), _) if bytes.is_some_and(|bytes| bytes != size) => {
                format!("another file of {size} bytes")
            }
            (Ok(_), _) => "yes".to_owned(),
            (Err(_), Some(part)) => format!("{} of it", HumanBytes(part)),
            (Err(_), None) => "no".to_owned(),
        };
        let size = bytes.map_or("unknown".to_owned(), |bytes| HumanBytes(bytes).to_string());
        Ok([name.clone(), environment.clone(), size, state])
    })
}

#[cfg(test)]
mod tests;
