//! The device on which training computes.

use anyhow::{Context, anyhow};
use quad_policy::Precision;
use quad_run::config::Device;
use quad_runtime::Hint;

/// Checks that the device is present and can compute with this precision.
pub(crate) fn check(device: Device, precision: Precision) -> anyhow::Result<()> {
    if device == Device::Cuda && precision != Precision::F32 {
        return Err(anyhow!("on a GPU the update computes in f32 only"))
            .hint("use --precision f32");
    }
    open(device).map(drop)
}

/// The device as candle knows it.
pub(super) fn open(device: Device) -> anyhow::Result<candle_core::Device> {
    let hint = match cfg!(feature = "cuda") {
        true => {
            "does `nvidia-smi` show a GPU on this machine, and a driver for CUDA 13? --device cpu needs neither"
        }
        false => "build a learner that can by deploy/cuda.sh, or train with --device cpu",
    };
    match device {
        Device::Cpu => Ok(candle_core::Device::Cpu),
        Device::Cuda => {
            quad_nn::open_gpu().context("this learner cannot train on a GPU here").hint(hint)
        }
    }
}
