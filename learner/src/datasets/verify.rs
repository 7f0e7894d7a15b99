//! Whether a file is the one that the catalogue means.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use quad_dataset::NamedDataset;
use sha2::{Digest, Sha256};

/// How an HDF5 file begins, unless somebody put a block of their own in front, which D4RL did not.
const HDF5_SIGNATURE: &[u8] = b"\x89HDF\r\n\x1a\n";
/// Read at a time.
const CHUNK: usize = 1 << 20;

/// Why a file is not the one that the catalogue means.
#[derive(Debug, PartialEq, thiserror::Error)]
pub enum Mismatch {
    /// Another size.
    #[error("it has {found} bytes, but must have {expected}")]
    Size {
        /// What it is.
        found: u64,
        /// What it must be.
        expected: u64,
    },
    /// Not HDF5: what some servers send instead of an error is a page for people.
    #[error("it is not an HDF5 file")]
    NotHdf5,
    /// Other contents.
    #[error("its SHA-256 is {found}, but must be {expected}")]
    Checksum {
        /// What it is.
        found: String,
        /// What is known of what it must be.
        expected: String,
    },
}

/// SHA-256 of a file in lower-case hexadecimal, if the file is what `dataset` says as far as that is known.
pub fn verify(dataset: &NamedDataset, path: &Path) -> io::Result<Result<String, Mismatch>> {
    let mut file = File::open(path)?;
    let found = file.metadata()?.len();
    if let Some(expected) = dataset.bytes.filter(|expected| *expected != found) {
        return Ok(Err(Mismatch::Size { found, expected }));
    }
    let mut start = Vec::new();
    file.by_ref().take(HDF5_SIGNATURE.len() as u64).read_to_end(&mut start)?;
    if start != HDF5_SIGNATURE {
        return Ok(Err(Mismatch::NotHdf5));
    }
    let found = sha256(path)?;
    match dataset.sha256.matches(&found) {
        true => Ok(Ok(found)),
        false => Ok(Err(Mismatch::Checksum { found, expected: dataset.sha256.to_string() })),
    }
}

/// SHA-256 of a file in lower-case hexadecimal.
pub fn sha256(path: &Path) -> io::Result<String> {
    let mut file = File::open(path)?;
    let mut hasher = Sha256::new();
    let mut chunk = vec![0; CHUNK];
    loop {
        match file.read(&mut chunk)? {
            0 => return Ok(format!("{:x}", hasher.finalize())),
            count => hasher.update(&chunk[..count]),
        }
    }
}
