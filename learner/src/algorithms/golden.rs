//! What the golden tests of all algorithms share (docs/golden.md).

#[path = "../../../tests/golden/golden.rs"]
mod reader;

use super::algorithm::{Metric, Minibatch, Setting};
use candle_core::{Device, Tensor};
use quad_policy::{Precision, Tensors};
pub(super) use reader::{Golden, fresh, goldens, make};

/// Where updates are tested: on the CPU, and on a GPU with the feature `cuda`. Without a GPU that share is skipped,
/// unless QUAD_REQUIRE_PEERS=1 asks for one.
#[allow(clippy::print_stderr)] // what is skipped is said
pub(super) fn devices() -> Vec<Device> {
    let mut devices = vec![Device::Cpu];
    if cfg!(feature = "cuda") {
        match Device::new_cuda(0) {
            Ok(gpu) => devices.push(gpu),
            Err(error) => {
                let required = std::env::var_os("QUAD_REQUIRE_PEERS").is_some_and(|value| value == "1");
                assert!(!required, "there is no GPU: {error}");
                eprintln!("skipped on CUDA, because there is no GPU: {error}");
            }
        }
    }
    devices
}

/// Checks that an update gave what a golden folder expects: each metric and each tensor of the state.
pub(super) fn check_update(golden: &Golden, metrics: &[Metric], values: &[f32], state: Tensors) {
    for (metric, value) in metrics.iter().zip(values) {
        if golden.expected.contains_key(metric.name) {
            golden.close(metric.name, &Tensor::new(*value, &Device::Cpu).unwrap());
        }
    }
    for (name, tensor) in state {
        golden.close(&name, &tensor);
    }
}

/// The setting of a golden folder.
pub(super) fn golden_setting(golden: &Golden, device: &Device) -> Setting {
    Setting {
        observation_dim: golden.count("/observation_dim"),
        action_dim: golden.count("/action_dim"),
        batch_size: golden.count("/batch_size"),
        total_steps: golden.count("/total_steps") as u64,
        seed: 0,
        precision: Precision::F32,
        device: device.clone(),
    }
}

/// The hyper-parameters of a golden folder.
pub(super) fn golden_table(golden: &Golden) -> toml::Table {
    toml::Table::try_from(&golden.config["agent"]).unwrap()
}

/// The batch of a golden folder.
pub(super) fn golden_batch(golden: &Golden, device: &Device) -> Minibatch {
    let input = |name: &str| golden.input(name, device);
    Minibatch {
        observations: input("observations"),
        actions: input("actions"),
        rewards: input("rewards"),
        next_observations: input("next_observations"),
        masks: input("masks"),
    }
}
