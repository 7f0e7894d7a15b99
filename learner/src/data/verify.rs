//! Checks files against the catalog.

use std::io::{self, Read};
use std::path::Path;

use quad_dataset::NamedDataset;
use quad_dataset::benchmarks::Format;
use quad_run::files;
use sha2::{Digest, Sha256};

/// SHA-256 of a file in lower-case hexadecimal if size, format and checksum are those of the
/// catalog; otherwise the mismatch.
pub fn verify(dataset: &NamedDataset, path: &Path) -> io::Result<Result<String, String>> {
    let mut file = files::open_named(path)?;
    let found = file.metadata()?.len();
    if let Some(expected) = dataset.bytes.filter(|expected| *expected != found) {
        let mismatch = format!("it has {found} bytes, but must have {expected}");
        return Ok(Err(mismatch));
    }
    let mut start = Vec::new();
    let format = dataset.benchmark.format;
    file.by_ref().take(16).read_to_end(&mut start)?;
    // Some servers send a web page instead of an error.
    if Format::from_start(&start) != Some(format) {
        return Ok(Err(format!("it is not an {}", format.name())));
    }
    let found = sha256(path)?;
    Ok(match &dataset.sha256 {
        Some(expected) if *expected != found => {
            Err(format!("its SHA-256 is {found}, but must be {expected}"))
        }
        _ => Ok(found),
    })
}

/// SHA-256 of a file in lower-case hexadecimal.
pub fn sha256(path: &Path) -> io::Result<String> {
    let mut file = files::open_named(path)?;
    let mut hasher = Sha256::new();
    io::copy(&mut file, &mut hasher)?;
    Ok(format!("{:x}", hasher.finalize()))
}
