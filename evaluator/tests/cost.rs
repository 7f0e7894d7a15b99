//! Policies take no more memory than they declare, by which an evaluator refuses jobs.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use candle_core::{DType, Device, Tensor};
use quad_nn::{Attention, TrajectoryConfig};
use quad_policy::{
    ActorCriticShape, Choice, DiffuserShape, DiffusionShape, GaussianShape, Header, MlpConfig,
    PolicyConfig, Precision, Rule, Scaling, ScorePolicyShape, Spread, ValueGuidance, load_policy,
};

/// Bytes that are not accounted for, such as the embedding of each denoising step.
const SLACK: usize = 1 << 20;

/// The system's allocator, which counts.
struct Counting;

static NOW: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

// SAFETY: passes every call on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let size = layout.size();
        PEAK.fetch_max(NOW.fetch_add(size, Relaxed) + size, Relaxed);
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        NOW.fetch_sub(layout.size(), Relaxed);
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const SIZES: (usize, usize) = (11, 3);

fn diffusion(hidden: usize, critics: usize, steps: usize, choice: Choice) -> PolicyConfig {
    let layers = MlpConfig::mish(&[hidden; 3]);
    let mut shape = DiffusionShape::quad(SIZES, &layers, critics, steps);
    shape.value = (choice.rule == Rule::Nearest).then_some(layers);
    PolicyConfig::Diffusion { shape, choice }
}

fn gaussian(hidden: usize) -> PolicyConfig {
    let shape = GaussianShape {
        observation_dim: SIZES.0,
        action_dim: SIZES.1,
        actor: MlpConfig::mish(&[hidden; 3]),
        spread: Spread::None,
    };
    PolicyConfig::Gaussian { shape }
}

fn actor_critic(hidden: usize, norm: bool) -> ActorCriticShape {
    let actor = MlpConfig::mish(&[hidden; 3]);
    let mut critic = actor.clone();
    critic.norm = norm;
    ActorCriticShape { observation_dim: SIZES.0, action_dim: SIZES.1, actor, critic, critics: 2 }
}

fn squashed(hidden: usize, norm: bool) -> PolicyConfig {
    let choice = Choice::best_of(1024);
    PolicyConfig::Squashed { shape: actor_critic(hidden, norm), choice }
}

fn flow(hidden: usize, candidates: u32) -> PolicyConfig {
    let (shape, choice) = (actor_critic(hidden, false), Choice::best_of(candidates));
    PolicyConfig::Flow { shape, flow_steps: 10, choice }
}

fn score(widths: &[usize], candidates: u32) -> PolicyConfig {
    let shape = ScorePolicyShape {
        observation_dim: SIZES.0,
        action_dim: SIZES.1,
        actor: MlpConfig::mish(widths),
        critic: MlpConfig::mish(&[8]),
        evaluations: 4,
    };
    let choice = Choice::best_of(candidates);
    PolicyConfig::Score { shape, choice }
}

/// Attention has heads and their width.
fn diffuser(
    (horizon, channels): (usize, usize),
    multipliers: &[usize],
    attention: Option<[usize; 2]>,
    plans: u32,
) -> PolicyConfig {
    let network = TrajectoryConfig {
        horizon,
        channels,
        multipliers: multipliers.to_vec(),
        groups: 8,
        attention: attention.map(|[heads, width]| Attention { heads, width }),
    };
    let guidance = ValueGuidance { steps: 1, scale: 0.1, stop: 0 };
    let shape = DiffuserShape {
        observation_dim: SIZES.0,
        action_dim: SIZES.1,
        network,
        diffusion_steps: 3,
        guidance,
        replan_every: 1,
        units: Scaling::default(),
    };
    let choice = Choice::best_of(plans);
    PolicyConfig::Diffuser { shape, choice }
}

#[test]
fn actions_take_no_more_memory_than_the_policy_says() {
    let best_of = Choice::best_of;
    let mut nearest = best_of(1000);
    nearest.rule = Rule::Nearest;
    let guided = |candidates| Choice { guidance: 1.0, ..best_of(candidates) };
    let halfcheetah = Some([4, 32]);
    let cases = [
        ("the paper's", diffusion(256, 10, 5, best_of(50)), 10),
        ("many critics", diffusion(1, 4096, 1, best_of(32)), 64),
        ("many steps", diffusion(4, 1, 1000, best_of(8)), 256),
        ("many candidates", diffusion(8, 2, 5, best_of(1000)), 64),
        ("a value function", diffusion(8, 2, 5, nearest), 256),
        ("with guidance", diffusion(64, 10, 2, guided(10)), 64),
        ("many candidates with guidance", diffusion(8, 2, 2, guided(1000)), 64),
        ("a Gaussian", gaussian(256), 256),
        ("a squashed Gaussian", squashed(4, false), 64),
        ("critics with a norm", squashed(64, true), 10),
        ("a flow", flow(64, 32), 64),
        ("a flow to many candidates", flow(8, 1024), 64),
        ("a score network", score(&[512, 256, 128], 32), 10),
        ("a score network of one block", score(&[64], 1000), 64),
        ("Hopper's planner", diffuser((32, 32), &[1, 2, 4, 8], None, 64), 1),
        ("HalfCheetah's", diffuser((4, 32), &[1, 4, 8], halfcheetah, 64), 1),
        ("many plans", diffuser((16, 16), &[1, 2, 4], None, 8), 64),
        ("one step", diffuser((1, 32), &[1], Some([16, 64]), 1000), 4),
    ];
    for (name, config, n) in cases {
        let zeros =
            |layout: &quad_nn::Layout| Tensor::zeros(layout.count(), DType::F32, &Device::Cpu);
        let tensors = config.tensors(zeros).unwrap();
        let file = Header::new(config, ()).to_safetensors(&tensors).unwrap();
        let policy = load_policy(&file, Precision::F32).unwrap();
        let said = policy.memory(n) as usize;
        let mut states: Vec<_> = (0..n as u64).map(|seed| policy.begin(seed)).collect();
        let observations = vec![0.5; n * SIZES.0];
        let mut actions = vec![0.0; n * SIZES.1];
        let mut act = || policy.act(&observations, &mut states, &mut actions).unwrap();
        // Allocates the threads' own buffers.
        act();
        let before = NOW.load(Relaxed);
        PEAK.store(before, Relaxed);
        act();
        let taken = PEAK.load(Relaxed) - before;
        assert!(taken <= said + SLACK, "{name}: {taken} bytes, not {said}");
    }
}
