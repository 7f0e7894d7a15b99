//! Reads golden folders (tests/golden/README.md).

use candle_core::{DType, Device, Tensor};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

#[path = "../fixtures/python.rs"]
mod python;
use python::python;

/// Largest error, relative to the number itself or, for numbers near zero, to their tensor's root
/// mean square.
const TOLERANCE: f32 = 1e-4;
/// Largest error for numbers of a fresh seed, any of which may happen to lie close to zero. A slip
/// shows far more.
const FRESH_TOLERANCE: f32 = 1e-2;

/// The seed of folders that are made for a test. One that never changes, so that a change is what
/// makes the test fail.
const FRESH_SEED: &str = "1000";

/// The script that makes golden folders.
pub const MAKE: &str = "tests/golden/make.py";

/// A golden folder.
pub struct Golden {
    pub folder: PathBuf,
    pub config: serde_json::Value,
    /// Tensors by name.
    pub state: BTreeMap<String, Tensor>,
    pub inputs: BTreeMap<String, Tensor>,
    pub expected: BTreeMap<String, Tensor>,
    tolerance: f32,
}

/// Runs a script of the repository that needs JAX; says whether it ran.
pub fn run(script: &str, arguments: &[&str]) -> bool {
    let home = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let Some(python) = python("jax, safetensors") else { return false };
    let output = Command::new(python).arg(home.join(script)).args(arguments).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{script} {}: {text}", arguments.join(" "));
    true
}

/// Folders of all variants, of the seed that GOLDEN_SEED names; none where make.py cannot run.
pub fn fresh() -> Vec<Golden> {
    let seed = std::env::var("GOLDEN_SEED").unwrap_or_else(|_| FRESH_SEED.to_owned());
    let home = std::env::temp_dir().join(format!("golden-{seed}-{}", std::process::id()));
    let out = home.to_str().unwrap();
    if !run(MAKE, &["--seed", &seed, "--variant", "all", "--out", out]) {
        return Vec::new();
    }
    let goldens = open_all(&home);
    std::fs::remove_dir_all(&home).unwrap();
    goldens.into_iter().map(|golden| Golden { tolerance: FRESH_TOLERANCE, ..golden }).collect()
}

/// The folders of one algorithm among the committed ones, or the folder that GOLDEN_DIR names.
pub fn goldens(algorithm: &str) -> Vec<Golden> {
    let mut goldens = match std::env::var_os("GOLDEN_DIR") {
        Some(folder) => vec![Golden::open(folder.into())],
        None => committed(),
    };
    goldens.retain(|golden| golden.config["algorithm"] == algorithm);
    goldens
}

/// All committed folders.
pub fn committed() -> Vec<Golden> {
    open_all(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden"))
}

fn open_all(home: &Path) -> Vec<Golden> {
    let mut folders: Vec<_> =
        std::fs::read_dir(home).unwrap().map(|entry| entry.unwrap().path()).collect();
    folders.retain(|folder| folder.join("config.json").exists());
    folders.sort();
    folders.into_iter().map(Golden::open).collect()
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
            tolerance: TOLERANCE,
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
        let input = self
            .inputs
            .get(name)
            .unwrap_or_else(|| panic!("input {name} in {}", self.folder.display()));
        input.to_device(device).unwrap()
    }

    /// Asserts that numbers are those expected under this name, whatever their shape.
    pub fn close(&self, name: &str, actual: &Tensor) {
        let expected = self
            .expected
            .get(name)
            .unwrap_or_else(|| panic!("{name} in {}", self.folder.display()));
        let numbers = |x: &Tensor| {
            x.to_dtype(DType::F32).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()
        };
        let (actual, expected) = (numbers(actual), numbers(expected));
        assert_eq!(actual.len(), expected.len(), "{name} in {}", self.folder.display());
        let size = (expected.iter().map(|x| x * x).sum::<f32>() / expected.len() as f32).sqrt();
        for (i, (actual, expected)) in actual.iter().zip(&expected).enumerate() {
            let error = (actual - expected).abs() / expected.abs().max(size).max(1e-30);
            let place = self.folder.display();
            assert!(
                error <= self.tolerance,
                "{name} at {i} in {place}: {actual}, but expected is {expected}"
            );
        }
    }
}
