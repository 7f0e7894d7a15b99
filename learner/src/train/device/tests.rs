//! Tests of `train/device.rs`.

use super::*;

#[test]
fn a_gpu_that_cannot_be_used_is_an_error() {
    if !cfg!(feature = "cuda") {
        let error = check(Device::Cuda, Precision::F32).unwrap_err();
        assert!(error.to_string().contains("cannot train on a GPU"), "{error}");
    }
    let error = check(Device::Cuda, Precision::Bf16).unwrap_err();
    assert!(error.to_string().contains("f32"), "{error}");
    assert!(check(Device::Cpu, Precision::Bf16).is_ok());
}
