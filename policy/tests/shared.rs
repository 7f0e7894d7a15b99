//! One policy, asked by many jobs of rayon's at once, as by the batches of `evaluator score`.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use candle_core::{DType, Device, Tensor};
use quad_nn::{MlpConfig, Precision};
use quad_policy::{Choice, DiffusionShape, Header, PolicyConfig, load_policy};
use rayon::prelude::*;

/// Policies, each asked by all threads at once.
const POLICIES: usize = 100;

/// The file of a policy whose kernels take a while to lay out.
fn file() -> Vec<u8> {
    let shape = DiffusionShape::quad((3, 1), &MlpConfig::mish(&[256, 256]), 64, 1);
    let policy = PolicyConfig::Diffusion { shape, choice: Choice::best_of(2) };
    let tensors =
        policy.tensors(|layout| Tensor::zeros(layout.count(), DType::F32, &Device::Cpu)).unwrap();
    Header::new(policy, ()).to_safetensors(&tensors).unwrap()
}

/// A call shares out its work. A thread that waits for a part of it takes up another job meanwhile,
/// which asks the same policy.
#[test]
fn a_call_waits_for_no_other_call_of_its_policy() {
    let (tell, told) = mpsc::channel();
    thread::spawn(move || {
        let (file, pool) =
            (file(), rayon::ThreadPoolBuilder::new().num_threads(8).build().unwrap());
        for number in 0..POLICIES {
            let precision = if number % 2 == 0 { Precision::F32 } else { Precision::Bf16 };
            let policy = load_policy(&file, precision).unwrap();
            let ask = |_| assert_eq!(policy.value(&[0.0; 3], &[0.0]).unwrap(), [0.0]);
            // The first call is made on two threads, while six have nothing to do but take parts of
            // its work.
            pool.broadcast(|thread| {
                if thread.index() < 2 {
                    (0..8).into_par_iter().with_max_len(1).for_each(ask);
                }
            });
            tell.send(number).unwrap();
        }
    });
    for number in 0..POLICIES {
        assert_eq!(
            told.recv_timeout(Duration::from_secs(60)),
            Ok(number),
            "calls of a policy wait for one another"
        );
    }
}
