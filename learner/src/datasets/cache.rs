//! The folder in which D4RL keeps its files, shared with everything else that uses D4RL.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use indicatif::HumanBytes;
use quad_dataset::{NamedDataset, catalogue};
use quad_service::Hint;

/// The environment variable that names another folder than the one in the home folder; D4RL's.
const VARIABLE: &str = "D4RL_DATASET_DIR";

/// Where D4RL keeps its files.
pub fn folder() -> anyhow::Result<PathBuf> {
    if let Some(folder) = std::env::var_os(VARIABLE).filter(|folder| !folder.is_empty()) {
        return Ok(folder.into());
    }
    let home = std::env::home_dir().filter(|home| !home.as_os_str().is_empty());
    home.map(|home| home.join(".d4rl/datasets"))
        .ok_or_else(|| anyhow!("there is no home folder to keep datasets in"))
        .hint(format!("name a folder in {VARIABLE}"))
}

/// The catalogue as a table, with what is in a folder of it already.
pub fn table(folder: &Path) -> String {
    let mut rows = vec![["dataset", "environment", "size", "in the cache"].map(str::to_owned)];
    rows.extend(catalogue::all().iter().map(|dataset| {
        let size = dataset.bytes.map_or("unknown".to_owned(), |bytes| HumanBytes(bytes).to_string());
        [dataset.name.clone(), dataset.environment.clone(), size, state(dataset, folder)]
    }));
    let [name, environment, size, _] =
        [0, 1, 2, 3].map(|column| rows.iter().map(|row| row[column].len()).max().unwrap_or(0));
    let line =
        |row: &[String; 4]| format!("{:name$}  {:environment$}  {:>size$}  {}\n", row[0], row[1], row[2], row[3]);
    let lines: String = rows.iter().map(line).collect();
    format!("{lines}\ncache folder: {}", folder.display())
}

/// Checksums are not computed for this.
fn state(dataset: &NamedDataset, folder: &Path) -> String {
    let path = folder.join(&dataset.file);
    let length = |path: &Path| path.metadata().map(|metadata| metadata.len()).ok();
    match (length(&path), length(&path.with_added_extension("partial"))) {
        (Some(found), _) if dataset.bytes.is_some_and(|bytes| bytes != found) => {
            format!("another file of {found} bytes")
        }
        (Some(_), _) => "yes".to_owned(),
        (None, Some(found)) => format!("{} of it", HumanBytes(found)),
        (None, None) => "no".to_owned(),
    }
}
