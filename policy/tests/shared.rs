//! One policy used by many rayon jobs at once, as by the batches of `evaluator score`.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use candle_core::{DType, Device, Tensor};
use quad_nn::{MlpConfig, Precision};
use quad_policy::{Choice, DiffusionShape, Header, PolicyConfig, load_policy};
use rayon::prelude::*;

/// Policies, each used by all threads at once.
const POLICIES: usize = 100;

/// The file of a policy whose kernels take a while to pack.
fn file() -> Vec<u8> {
    let shape = DiffusionShape::quad((3, 1), &MlpConfig::mish(&[256, 256]), 64, 1);
    let policy = PolicyConfig::Diffusion { shape, choice: Choice::best_of(2) };
    let zeros = policy.tensors(|layout| Tensor::zeros(layout.count(), DType::F32, &Device::Cpu));
    Header::new(policy, ()).to_safetensors(&zeros.unwrap()).unwrap()
}

/// A thread that waits for a part of its own call can start another call of the same policy.
#[test]
fn a_call_waits_for_no_other_call_of_its_policy() {
    let (tx, rx) = mpsc::channel();
    thread::spawn(move || {
        let file = file();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(8).build().unwrap();
        for number in 0..POLICIES {
            let precision = [Precision::F32, Precision::Bf16][number % 2];
            let policy = load_policy(&file, precision).unwrap();
            let value = |_| assert_eq!(policy.value(&[0.0; 3], &[0.0]).unwrap(), [0.0]);
            // Two threads make the first calls; six others take parts of their work.
            pool.broadcast(|thread| {
                if thread.index() < 2 {
                    (0..8).into_par_iter().with_max_len(1).for_each(value);
                }
            });
            tx.send(number).unwrap();
        }
    });
    for number in 0..POLICIES {
        let done = rx.recv_timeout(Duration::from_secs(60));
        assert_eq!(done, Ok(number), "calls of a policy wait for one another");
    }
}
