//! What a policy says that its actions take is what they take: an evaluator refuses jobs by it.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::alloc::{GlobalAlloc, Layout as Block, System};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use candle_core::{Device, Tensor};
use quad_policy::{
    ActionNoise, Description, DiffusionPolicy, DiffusionShape, Ensemble, GaussianPolicy, GaussianShape, Layout,
    NoisePredictor, Policy, Precision, Weights, load_policy,
};

/// What is not counted, such as the embedding of each denoising step: little of what an evaluator gives, bytes.
const SMALL_CHANGE: usize = 1 << 20;

/// The system's allocator, which counts.
struct Counting;

static NOW: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

// SAFETY: everything is handed on to the system's allocator as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, block: Block) -> *mut u8 {
        PEAK.fetch_max(NOW.fetch_add(block.size(), Relaxed) + block.size(), Relaxed);
        unsafe { System.alloc(block) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, block: Block) {
        NOW.fetch_sub(block.size(), Relaxed);
        unsafe { System.dealloc(pointer, block) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn zeros(layout: Layout) -> Weights {
    let values = Tensor::zeros(layout.count(), candle_core::DType::F32, &Device::Cpu).unwrap();
    Weights::constant(layout, values)
}

fn diffusion(hidden: usize, critics: usize, diffusion_steps: usize) -> Box<dyn Policy> {
    let shape = DiffusionShape { observation_dim: 11, action_dim: 3, hidden, critics, diffusion_steps };
    let actor = NoisePredictor::new(shape.actor(), zeros(shape.actor().layout()), Precision::F32);
    let critics = Ensemble::new(shape.critics(), zeros(shape.critics().layout()), Precision::F32);
    let tensors = DiffusionPolicy::tensors(&actor, &critics).unwrap();
    load_policy(&Description::Diffusion(shape).to_safetensors(&tensors).unwrap(), Precision::F32).unwrap()
}

fn gaussian(hidden: usize) -> Box<dyn Policy> {
    let shape = GaussianShape { observation_dim: 11, action_dim: 3, hidden };
    let actor = Ensemble::new(shape.actor(), zeros(shape.actor().layout()), Precision::F32);
    let tensors = GaussianPolicy::tensors(&actor).unwrap();
    load_policy(&Description::Gaussian(shape).to_safetensors(&tensors).unwrap(), Precision::F32).unwrap()
}

#[test]
fn actions_take_no_more_memory_than_was_said() {
    let cases: [(&str, Box<dyn Policy>, usize, usize); 5] = [
        ("the paper's", diffusion(256, 10, 5), 10, 50),
        ("many critics", diffusion(1, 4096, 1), 64, 32),
        ("many steps", diffusion(4, 1, 1000), 256, 8),
        ("many candidates", diffusion(8, 2, 5), 1, 65_536),
        ("a Gaussian", gaussian(256), 256, 1),
    ];
    for (name, policy, states, candidates) in cases {
        let said = policy.cost(states, candidates).bytes as usize;
        let mut noise: Vec<_> = (0..states as u64).map(ActionNoise::new).collect();
        let (observations, mut actions) = (vec![0.5; states * 11], vec![0.0; states * 3]);
        let mut act = || policy.act(&observations, candidates, &mut noise, &mut actions).unwrap();
        // What threads keep for themselves is there then.
        act();
        let before = NOW.load(Relaxed);
        PEAK.store(before, Relaxed);
        act();
        let took = PEAK.load(Relaxed) - before;
        assert!(took <= said + SMALL_CHANGE, "{name}: {took} bytes were taken, {said} were said");
    }
}
