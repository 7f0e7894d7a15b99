//! Where the tests of the tensors' update run: on candle's CPU, and on a GPU with the feature `cuda`.

#![allow(clippy::print_stderr)] // what is skipped is said

use candle_core::Device;

/// The devices to test on. Without a GPU the feature's share is skipped, unless QUAD_REQUIRE_PEERS asks for one.
pub fn devices() -> Vec<Device> {
    let mut devices = vec![Device::Cpu];
    if cfg!(feature = "cuda") {
        match Device::new_cuda(0) {
            Ok(gpu) => devices.push(gpu),
            Err(error) => {
                assert!(std::env::var_os("QUAD_REQUIRE_PEERS").is_none(), "there is no GPU: {error}");
                eprintln!("skipped on CUDA, because there is no GPU: {error}");
            }
        }
    }
    devices
}
