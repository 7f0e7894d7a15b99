//! Where a file of weights comes from, so that it can be scored again.

use safetensors::{SafeTensorError, SafeTensors};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// Key of the origin in a safetensors file's metadata.
const KEY: &str = "origin";
/// Where safetensors' header has its metadata.
const METADATA: &str = "__metadata__";
/// A safetensors file begins with the length of its header, as a `u64`.
const LENGTH: usize = size_of::<u64>();

/// Where a snapshot comes from, and how its run evaluates it. It is in the metadata of the snapshot's safetensors file as
/// JSON.
///
/// All of it is a function of the run's configuration, so runs of the same configuration still make the same bytes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// Environment that the policy acts in.
    pub environment: String,
    /// Seed of the run, which with `step` decides the [episodes](crate::episode_seeds).
    pub seed: u64,
    /// Gradient steps so far.
    pub step: u64,
    /// Episodes of the evaluation.
    pub episodes: u32,
    /// Actions that the policy draws in each state before it takes the best.
    pub candidates: u32,
}

/// Bytes that no origin can be written to or read from.
#[derive(Debug, thiserror::Error)]
pub enum OriginError {
    /// They are no safetensors file.
    #[error("not a safetensors file, or a damaged or incomplete one")]
    Unreadable(#[from] SafeTensorError),
    /// The metadata is there, but is something else.
    #[error("what the file says about its origin is not understood")]
    Content(#[from] serde_json::Error),
}

impl Origin {
    /// The safetensors file with this origin in its metadata: always the same bytes for the same file and origin.
    ///
    /// (safetensors' own writer takes a `HashMap`, whose order differs each time as soon as it has two entries.)
    ///
    /// # Errors
    /// Bytes that are no safetensors file.
    pub fn attach(&self, file: &[u8]) -> Result<Vec<u8>, OriginError> {
        let (length, _) = SafeTensors::read_metadata(file)?;
        let (header, data) = file[LENGTH..].split_at(length);
        let mut header: Map<String, Value> = serde_json::from_slice(header)?;
        let metadata = header.entry(METADATA).or_insert_with(|| Map::new().into());
        metadata[KEY] = serde_json::to_string(self)?.into();
        let mut header = serde_json::to_vec(&header)?;
        // The tensors behind it stay aligned.
        header.resize(header.len().next_multiple_of(LENGTH), b' ');
        Ok([&(header.len() as u64).to_le_bytes(), header.as_slice(), data].concat())
    }

    /// What a safetensors file says of its origin; none if it says nothing.
    ///
    /// # Errors
    /// Bytes that are no safetensors file, or an origin that is not understood.
    pub fn read(file: &[u8]) -> Result<Option<Self>, OriginError> {
        let (_, metadata) = SafeTensors::read_metadata(file)?;
        let origin = metadata.metadata().as_ref().and_then(|metadata| metadata.get(KEY));
        Ok(origin.map(|origin| serde_json::from_str(origin)).transpose()?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use safetensors::{Dtype, serialize, tensor::TensorView};
    use std::collections::HashMap;

    fn origin() -> Origin {
        Origin { environment: "hopper".to_owned(), seed: 1 << 53, step: 3000, episodes: 10, candidates: 10 }
    }

    fn file(metadata: Option<HashMap<String, String>>) -> Vec<u8> {
        let numbers = [1.5_f32, -2.5].map(f32::to_le_bytes);
        let tensor = |i: usize| TensorView::new(Dtype::F32, vec![1], &numbers[i]).unwrap();
        serialize([("b", tensor(0)), ("a", tensor(1))], metadata).unwrap()
    }

    #[test]
    fn an_origin_is_read_back_and_changes_nothing_else() {
        let policy = HashMap::from([("policy".to_owned(), "\"quoted\"".to_owned())]);
        for metadata in [Some(policy), None] {
            let plain = file(metadata.clone());
            assert_eq!(Origin::read(&plain).unwrap(), None);
            let attached = origin().attach(&plain).unwrap();
            assert_eq!(Origin::read(&attached).unwrap(), Some(origin()));
            let (length, read) = SafeTensors::read_metadata(&attached).unwrap();
            assert_eq!(length % LENGTH, 0);
            for (key, value) in metadata.unwrap_or_default() {
                assert_eq!(read.metadata().as_ref().unwrap()[&key], value);
            }
            let tensors = |file| {
                let mut tensors = SafeTensors::deserialize(file).unwrap().tensors();
                tensors.sort_by(|one, other| one.0.cmp(&other.0));
                tensors
            };
            assert_eq!(tensors(&attached), tensors(&plain));
            let again = Origin { step: 4000, ..origin() }.attach(&attached).unwrap();
            assert_eq!(Origin::read(&again).unwrap().map(|origin| origin.step), Some(4000));
        }
    }

    #[test]
    fn the_same_file_has_the_same_bytes() {
        let plain = file(Some(HashMap::from([("policy".to_owned(), "x".to_owned())])));
        let first = origin().attach(&plain).unwrap();
        // A `HashMap` of two would pass thirty times by chance once in 2^30.
        assert!((0..30).all(|_| origin().attach(&plain).unwrap() == first));
    }

    #[test]
    fn what_is_no_file_of_weights_is_an_error() {
        let attached = origin().attach(&file(None)).unwrap();
        for bytes in [&b""[..], b"no tensors", &attached[..attached.len() - 1]] {
            assert!(matches!(Origin::read(bytes), Err(OriginError::Unreadable(_))));
            assert!(matches!(origin().attach(bytes), Err(OriginError::Unreadable(_))));
        }
        let forged = file(Some(HashMap::from([(KEY.to_owned(), "{\"seed\": -1}".to_owned())])));
        assert!(matches!(Origin::read(&forged), Err(OriginError::Content(_))));
    }
}
