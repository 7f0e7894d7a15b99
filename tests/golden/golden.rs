//! Reads golden folders (docs/golden.md); shared by the tests of several crates.

use candle_core::{DType, Device, Tensor};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Largest error, relative to the number itself or, for numbers near zero, to their tensor's root mean square.
const TOLERANCE: f32 = 1e-4;

/// A golden folder.
pub struct Golden {
    pub folder: PathBuf,
    pub config: serde_json::Value,
    /// Tensors by name.
    pub state: BTreeMap<String, Tensor>,
    pub inputs: BTreeMap<String, Tensor>,
    pub expected: BTreeMap<String, Tensor>,
}

/// The folders of one algorithm: the committed ones, or the one that GOLDEN_DIR names.
pub fn goldens(algorithm: &str) -> Vec<Golden> {
    let of_algorithm = |golden: &Golden| golden.config["algorithm"] == algorithm;
    if let Some(folder) = std::env::var_os("GOLDEN_DIR") {
        return Vec::from_iter(Some(Golden::open(folder.into())).filter(of_algorithm));
    }
    let home = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden");
    let mut folders: Vec<_> = std::fs::read_dir(&home).unwrap().map(|entry| entry.unwrap().path()).collect();
    folders.retain(|folder| folder.join("config.json").exists());
    folders.sort();
    let goldens: Vec<_> = folders.into_iter().map(Golden::open).filter(of_algorithm).collect();
    assert!(!goldens.is_empty(), "there are no golden folders of {algorithm} in {}", home.display());
    goldens
}

impl Golden {
    pub fn open(folder: PathBuf) -> Self {
        let read = |name: &str| {
            let path = folder.join(name);
            std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
        };
        let tensors = |name: &str| {
            let tensors = candle_core::safetensors::load_buffer(&read(name), &Device::Cpu).unwrap();
            tensors.into_iter().collect()
        };
        Self {
            config: serde_json::from_slice(&read("config.json")).unwrap(),
            state: tensors("state.safetensors"),
            inputs: tensors("inputs.safetensors"),
            expected: tensors("expected.safetensors"),
            folder,
        }
    }

    /// A whole number of the configuration, e.g. `/agent/critics`.
    pub fn count(&self, pointer: &str) -> usize {
        let number = self.config.pointer(pointer).and_then(serde_json::Value::as_u64);
        number.unwrap_or_else(|| panic!("{pointer} in {}", self.folder.display())) as usize
    }

    /// An input on a device.
    pub fn input(&self, name: &str, device: &Device) -> Tensor {
        let input = self.inputs.get(name).unwrap_or_else(|| panic!("input {name} in {}", self.folder.display()));
        input.to_device(device).unwrap()
    }

    /// Asserts that numbers are those expected under this name, whatever their shape.
    pub fn close(&self, name: &str, found: &Tensor) {
        let expected = self.expected.get(name).unwrap_or_else(|| panic!("{name} in {}", self.folder.display()));
        let numbers = |x: &Tensor| x.to_dtype(DType::F32).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let (found, expected) = (numbers(found), numbers(expected));
        assert_eq!(found.len(), expected.len(), "{name} in {}", self.folder.display());
        let size = (expected.iter().map(|x| x * x).sum::<f32>() / expected.len() as f32).sqrt();
        for (i, (found, expected)) in found.iter().zip(&expected).enumerate() {
            let error = (found - expected).abs() / expected.abs().max(size).max(1e-30);
            let place = self.folder.display();
            assert!(error <= TOLERANCE, "{name} at {i} in {place}: {found}, but expected is {expected}");
        }
    }
}
