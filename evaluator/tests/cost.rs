//! The memory that a policy says its actions take is what they take: an evaluator refuses jobs by
//! it.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use candle_core::{DType, Device, Tensor};
use quad_nn::{Attention, TrajectoryConfig};
use quad_policy::{
    ActorCriticShape, Choice, DiffuserShape, DiffusionShape, GaussianShape, Header, MlpConfig,
    Policy, PolicyConfig, Precision, Rule, Scaling, ScorePolicyShape, ValueGuidance, load_policy,
};

/// What is not counted, such as the embedding of each denoising step: little of what an evaluator
/// gives, bytes.
const SMALL_CHANGE: usize = 1 << 20;

/// The system's allocator, which counts.
struct Counting;

static NOW: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

// SAFETY: everything is handed on to the system's allocator as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        PEAK.fetch_max(NOW.fetch_add(layout.size(), Relaxed) + layout.size(), Relaxed);
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        NOW.fetch_sub(layout.size(), Relaxed);
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn loaded(policy: PolicyConfig) -> Box<dyn Policy> {
    let tensors =
        policy.tensors(|layout| Tensor::zeros(layout.count(), DType::F32, &Device::Cpu)).unwrap();
    load_policy(&Header::new(policy, ()).to_safetensors(&tensors).unwrap(), Precision::F32).unwrap()
}

fn diffusion(
    hidden: usize,
    critics: usize,
    diffusion_steps: usize,
    choice: Choice,
) -> Box<dyn Policy> {
    let layers = MlpConfig::mish(&[hidden; 3]);
    let value = (choice.rule == Rule::Nearest).then(|| layers.clone());
    let shape = DiffusionShape {
        value,
        ..DiffusionShape::quad((11, 3), &layers, critics, diffusion_steps)
    };
    loaded(PolicyConfig::Diffusion { shape, choice })
}

fn gaussian(hidden: usize) -> Box<dyn Policy> {
    let shape =
        GaussianShape { observation_dim: 11, action_dim: 3, actor: MlpConfig::mish(&[hidden; 3]) };
    loaded(PolicyConfig::Gaussian { shape })
}

fn squashed(hidden: usize, norm: bool) -> Box<dyn Policy> {
    let actor = MlpConfig::mish(&[hidden; 3]);
    let critic = MlpConfig { norm, ..actor.clone() };
    let shape = ActorCriticShape { observation_dim: 11, action_dim: 3, actor, critic, critics: 2 };
    loaded(PolicyConfig::Squashed { shape, choice: Choice::best_of(1024) })
}

fn score(widths: &[usize], candidates: u32) -> Box<dyn Policy> {
    let actor = MlpConfig::mish(widths);
    let critic = MlpConfig::mish(&[8]);
    let shape =
        ScorePolicyShape { observation_dim: 11, action_dim: 3, actor, critic, evaluations: 4 };
    loaded(PolicyConfig::Score { shape, choice: Choice::best_of(candidates) })
}

fn planner(network: TrajectoryConfig, plans: u32) -> Box<dyn Policy> {
    let shape = DiffuserShape {
        observation_dim: 11,
        action_dim: 3,
        network,
        diffusion_steps: 3,
        guidance: ValueGuidance { steps: 1, scale: 0.1, stop: 0 },
        replan_every: 1,
        units: Scaling::default(),
    };
    loaded(PolicyConfig::Diffuser { shape, choice: Choice::best_of(plans) })
}

/// A planner's networks with eight groups.
fn windows(
    horizon: usize,
    channels: usize,
    multipliers: &[usize],
    attention: Option<Attention>,
) -> TrajectoryConfig {
    TrajectoryConfig { horizon, channels, multipliers: multipliers.to_vec(), groups: 8, attention }
}

#[test]
fn actions_take_no_more_memory_than_was_said() {
    let best_of = Choice::best_of;
    let nearest = Choice { rule: Rule::Nearest, ..best_of(1000) };
    let cases: [(&str, Box<dyn Policy>, usize); 14] = [
        ("the paper's", diffusion(256, 10, 5, best_of(50)), 10),
        ("many critics", diffusion(1, 4096, 1, best_of(32)), 64),
        ("many steps", diffusion(4, 1, 1000, best_of(8)), 256),
        ("many candidates", diffusion(8, 2, 5, best_of(1000)), 64),
        ("a value function", diffusion(8, 2, 5, nearest), 256),
        ("a Gaussian", gaussian(256), 256),
        ("a squashed Gaussian", squashed(4, false), 64),
        ("critics with a norm", squashed(64, true), 10),
        ("a score network", score(&[512, 256, 128], 32), 10),
        ("a score network of one block", score(&[64], 1000), 64),
        ("Diffuser's for Hopper", planner(windows(32, 32, &[1, 2, 4, 8], None), 64), 1),
        (
            "Diffuser's for HalfCheetah",
            planner(windows(4, 32, &[1, 4, 8], Some(Attention { heads: 4, width: 32 })), 64),
            1,
        ),
        ("many plans", planner(windows(16, 16, &[1, 2, 4], None), 8), 64),
        (
            "a plan of one step",
            planner(windows(1, 32, &[1], Some(Attention { heads: 16, width: 64 })), 1000),
            4,
        ),
    ];
    for (name, policy, n) in cases {
        let said = policy.memory(n) as usize;
        let mut states: Vec<_> = (0..n as u64).map(|seed| policy.begin(seed)).collect();
        let (observations, mut actions) = (vec![0.5; n * 11], vec![0.0; n * 3]);
        let mut act = || policy.act(&observations, &mut states, &mut actions).unwrap();
        // What threads keep for themselves is there then.
        act();
        let before = NOW.load(Relaxed);
        PEAK.store(before, Relaxed);
        act();
        let took = PEAK.load(Relaxed) - before;
        assert!(took <= said + SMALL_CHANGE, "{name}: {took} bytes were taken, {said} were said");
    }
}
