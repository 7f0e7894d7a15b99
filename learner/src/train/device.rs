//! Where training runs.

use anyhow::{Context, anyhow};
use quad_policy::Precision;
use quad_run::config::Device;
use quad_runtime::Hint;

/// Checks that the device is there and can compute with this precision.
///
/// # Errors
/// It is not, or it cannot.
pub(crate) fn check(device: Device, precision: Precision) -> anyhow::Result<()> {
    match (device, precision) {
        (Device::Cpu, _) => Ok(()),
        (Device::Cuda, Precision::F32) => gpu().map(drop),
        (Device::Cuda, _) => {
            Err(anyhow!("on a GPU the update computes in f32 only")).hint("use --precision f32")
        }
    }
}

/// The device, as candle knows it.
///
/// # Errors
/// There is no such device here.
pub(crate) fn open(device: Device) -> anyhow::Result<candle_core::Device> {
    match device {
        Device::Cpu => Ok(candle_core::Device::Cpu),
        Device::Cuda => gpu(),
    }
}

fn gpu() -> anyhow::Result<candle_core::Device> {
    let hint = match cfg!(feature = "cuda") {
        true => {
            "does `nvidia-smi` show a GPU on this machine, and a driver for CUDA 13? --device cpu needs neither"
        }
        false => "build a learner that can by deploy/cuda.sh, or train with --device cpu",
    };
    quad_nn::open_gpu().context("this learner cannot train on a GPU here").hint(hint)
}
