//! Policies take no more memory than they declare, by which an evaluator refuses jobs.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use candle_core::{DType, Device, Tensor};
use quad_policy::{
    Choice, DiffusionShape, Header, MlpConfig, PolicyConfig, Precision, Rule, Scaling, load_policy,
};
use serde_json::{Value, json};

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

/// Numbers in an observation and in an action.
const O: usize = 11;
const A: usize = 3;

fn diffusion(hidden: usize, critics: usize, steps: usize, choice: Choice) -> PolicyConfig {
    let layers = MlpConfig::mish(&[hidden; 3]);
    let mut shape = DiffusionShape::quad((O, A), &layers, critics, steps);
    shape.value = (choice.rule == Rule::Nearest).then_some(layers);
    PolicyConfig::Diffusion { shape, choice }
}

/// A policy as its file's header has it, with the best of some candidates.
fn policy(kind: &str, mut shape: Value, candidates: u32) -> PolicyConfig {
    shape["observation_dim"] = O.into();
    shape["action_dim"] = A.into();
    let mut config = json!({"kind": kind, "shape": shape});
    if kind != "gaussian" {
        config["choice"] = json!(Choice::best_of(candidates));
    }
    if kind == "flow" {
        config["flow_steps"] = 10.into();
    }
    serde_json::from_value(config).unwrap()
}

fn actor_critic(kind: &str, hidden: usize, norm: bool, candidates: u32) -> PolicyConfig {
    let (layers, mut critic) = (MlpConfig::mish(&[hidden; 3]), MlpConfig::mish(&[hidden; 3]));
    critic.norm = norm;
    policy(kind, json!({"actor": layers, "critic": critic, "critics": 2}), candidates)
}

fn score(widths: &[usize], candidates: u32) -> PolicyConfig {
    let [actor, critic] = [widths, &[8]].map(MlpConfig::mish);
    policy("score", json!({"actor": actor, "critic": critic, "evaluations": 4}), candidates)
}

fn planner(
    (horizon, channels): (usize, usize),
    multipliers: &[usize],
    attention: Value,
    plans: u32,
) -> PolicyConfig {
    let network = json!({"horizon": horizon, "channels": channels, "multipliers": multipliers, "groups": 8, "attention": attention});
    let guidance = json!({"steps": 1, "scale": 0.1, "stop": 0});
    let units = Scaling::default();
    let shape = json!({"network": network, "diffusion_steps": 3, "guidance": guidance, "replan_every": 1, "units": units});
    policy("planner", shape, plans)
}

#[test]
fn actions_take_no_more_memory_than_the_policy_says() {
    let best_of = Choice::best_of;
    let mut nearest = best_of(1000);
    nearest.rule = Rule::Nearest;
    let guided = |candidates| Choice { guidance: 1.0, ..best_of(candidates) };
    let gaussian = json!({"actor": MlpConfig::mish(&[256; 3])});
    let [narrow, wide] =
        [(4, 32), (16, 64)].map(|(heads, width)| json!({"heads": heads, "width": width}));
    let cases = [
        ("the paper's", diffusion(256, 10, 5, best_of(50)), 10),
        ("many critics", diffusion(1, 4096, 1, best_of(32)), 64),
        ("many steps", diffusion(4, 1, 1000, best_of(8)), 256),
        ("many candidates", diffusion(8, 2, 5, best_of(1000)), 64),
        ("a value function", diffusion(8, 2, 5, nearest), 256),
        ("with guidance", diffusion(64, 10, 2, guided(10)), 64),
        ("many candidates with guidance", diffusion(8, 2, 2, guided(1000)), 64),
        ("a Gaussian", policy("gaussian", gaussian, 1), 256),
        ("a squashed Gaussian", actor_critic("squashed", 4, false, 1024), 64),
        ("critics with a norm", actor_critic("squashed", 64, true, 1024), 10),
        ("a flow", actor_critic("flow", 64, false, 32), 64),
        ("a flow to many candidates", actor_critic("flow", 8, false, 1024), 64),
        ("a score network", score(&[512, 256, 128], 32), 10),
        ("a score network of one block", score(&[64], 1000), 64),
        ("Hopper's planner", planner((32, 32), &[1, 2, 4, 8], Value::Null, 64), 1),
        ("HalfCheetah's", planner((4, 32), &[1, 4, 8], narrow, 64), 1),
        ("many plans", planner((16, 16), &[1, 2, 4], Value::Null, 8), 64),
        ("one step", planner((1, 32), &[1], wide, 1000), 4),
    ];
    for (name, config, n) in cases {
        let zeros =
            |layout: &quad_nn::Layout| Tensor::zeros(layout.count(), DType::F32, &Device::Cpu);
        let tensors = config.tensors(zeros).unwrap();
        let file = Header::new(config, ()).to_safetensors(&tensors).unwrap();
        let policy = load_policy(&file, Precision::F32).unwrap();
        let said = policy.memory(n) as usize;
        let mut states: Vec<_> = (0..n as u64).map(|seed| policy.begin(seed)).collect();
        let observations = vec![0.5; n * O];
        let mut actions = vec![0.0; n * A];
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
