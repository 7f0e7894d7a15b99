//! Properties of the update on random inputs.

#![allow(clippy::unwrap_used)] // what cannot be had ends the run

mod devices;

use devices::devices;
use quad_dataset::Batch;
use quad_learner::agent::reference::{Reference, ReferenceState};
use quad_learner::agent::{
    Agent, AgentConfig, AgentState, EtaConfig, Guidance, StepMetrics, StepNoise, TargetReduce, TensorAgent,
};
use quad_policy::{Architecture, Parameters, Precision};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

const DIMS: (usize, usize) = (11, 3);
const GUIDANCE: [Guidance; 3] = [Guidance::Quad, Guidance::Dac, Guidance::None];

fn config(guidance: Guidance) -> AgentConfig {
    AgentConfig {
        hidden: 24,
        critics: 4,
        diffusion_steps: 5,
        // More than a tile of rows, and no multiple of it.
        batch_size: 150,
        gamma: 0.99,
        rho: 1.5,
        guidance,
        tau: 0.7,
        delta: 1e-8,
        samples: 3,
        target_reduce: TargetReduce::Mean,
        eta: EtaConfig { initial: 1.0, threshold: Some(0.3), rate: 0.01, minimum: 0.001, maximum: 100.0 },
        actor_learning_rate: 1e-3,
        critic_learning_rate: 1e-3,
        gradient_clip: 1.0,
        ema_rate: 0.05,
        nu_ema_rate: 0.1,
        actor_ema_every: 2,
        actor_ema_start: 0,
        precision: Precision::F32,
    }
}

fn batch(config: &AgentConfig, generator: &mut ChaCha8Rng) -> Batch {
    let size = config.batch_size;
    let mut numbers = |n: usize| (0..n).map(|_| generator.random_range(-1.0..1.0)).collect::<Vec<f32>>();
    Batch {
        observations: numbers(size * DIMS.0),
        actions: numbers(size * DIMS.1),
        rewards: numbers(size),
        next_observations: numbers(size * DIMS.0),
        masks: numbers(size).iter().map(|x| f32::from(*x > -0.8)).collect(),
        size,
    }
}

fn noise(config: &AgentConfig, generator: &mut ChaCha8Rng) -> StepNoise {
    let size = config.batch_size;
    let mut normals = |n: usize| (0..n).map(|_| StandardNormal.sample(generator)).collect::<Vec<f32>>();
    StepNoise {
        next: normals(config.diffusion_steps * size * config.samples * DIMS.1),
        epsilon: normals(size * DIMS.1),
        t: (0..size).map(|i| i % config.diffusion_steps + 1).collect(),
    }
}

fn fresh(config: &AgentConfig) -> (Architecture, AgentState) {
    let architecture = config.architecture(DIMS.0, DIMS.1);
    (architecture, AgentState::new(&architecture, config, 3))
}

/// That two updates reported the same, up to rounding in f32.
fn close(what: &str, a: &StepMetrics, b: &StepMetrics) {
    for (name, a, b) in [
        ("critic_loss", a.critic_loss, b.critic_loss),
        ("bc_loss", a.bc_loss, b.bc_loss),
        ("actor_loss", a.actor_loss, b.actor_loss),
        ("eta", a.eta, b.eta),
        ("lambda_mean", a.lambda_mean, b.lambda_mean),
        ("q_mean", a.q_mean, b.q_mean),
        ("nu_squared", a.nu_squared, b.nu_squared),
        ("critic_gradient_norm", a.critic_gradient_norm, b.critic_gradient_norm),
        ("actor_gradient_norm", a.actor_gradient_norm, b.actor_gradient_norm),
        ("learning_rate", a.learning_rate, b.learning_rate),
    ] {
        assert!((a - b).abs() <= 2e-4 * b.abs() + 1e-6, "{what}: {name} is {a}, not {b}");
    }
}

#[test]
fn fast_update_and_reference_agree_over_several_steps() {
    for (device, guidance) in devices().iter().flat_map(|device| GUIDANCE.map(|guidance| (device, guidance))) {
        let config = config(guidance);
        let (architecture, state) = fresh(&config);
        let mut slow = ReferenceState::new(&state, device).unwrap();
        let mut fast = Agent::from_state(state, &config, 50, 0);
        let reference = Reference { config: &config, architecture, total_steps: 50, device: device.clone() };
        let mut generator = ChaCha8Rng::seed_from_u64(9);
        for step in 0..5 {
            let (batch, noise) = (batch(&config, &mut generator), noise(&config, &mut generator));
            let a = fast.step(&batch, &noise).unwrap();
            let b = reference.step(&mut slow, &batch, &noise).unwrap();
            close(&format!("{device:?}, {guidance:?}, step {step}"), &a, &b);
        }
    }
}

#[test]
fn both_agents_start_with_the_same_weights_and_draw_the_same_noise() {
    let config = config(Guidance::Quad);
    let architecture = config.architecture(DIMS.0, DIMS.1);
    for device in devices() {
        let mut fast = Agent::new(architecture, &config, 50, 8).unwrap();
        let mut tensors = TensorAgent::new(architecture, &config, 50, 8, device.clone()).unwrap();
        assert_eq!(tensors.target_safetensors().unwrap(), fast.target_safetensors().unwrap(), "{device:?}");
        let mut generator = ChaCha8Rng::seed_from_u64(9);
        for step in 0..5 {
            let batch = batch(&config, &mut generator);
            close(&format!("{device:?}, step {step}"), &fast.update(&batch).unwrap(), &tensors.update(&batch).unwrap());
        }
        let bytes = tensors.target_safetensors().unwrap();
        let target = Parameters::from_safetensors(&architecture, &bytes).unwrap();
        for (a, b) in [(&target.actor, &fast.state().target.actor), (&target.critics, &fast.state().target.critics)] {
            let difference = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(difference < 1e-4, "{device:?}: a target's weight differs by {difference}");
        }
    }
}

#[test]
fn every_parameter_gets_a_finite_gradient_that_is_not_zero() {
    let config = config(Guidance::Quad);
    let (_, state) = fresh(&config);
    let mut agent = Agent::from_state(state, &config, 10, 0);
    let mut generator = ChaCha8Rng::seed_from_u64(1);
    agent.step(&batch(&config, &mut generator), &noise(&config, &mut generator)).unwrap();
    let state = agent.state();
    for (name, moments) in [("actor", &state.actor_moments), ("critics", &state.critic_moments)] {
        for (i, gradient) in moments.first.iter().enumerate() {
            assert!(gradient.is_finite() && *gradient != 0.0, "{name}: parameter {i} got {gradient}");
        }
    }
}

#[test]
fn an_infinite_temperature_is_dac() {
    let dac = config(Guidance::Dac);
    let quad = AgentConfig { tau: f32::INFINITY, ..config(Guidance::Quad) };
    let [dac, quad] = [dac, quad].map(|config| {
        let mut agent = Agent::from_state(fresh(&config).1, &config, 10, 0);
        let mut generator = ChaCha8Rng::seed_from_u64(4);
        for _ in 0..3 {
            agent.step(&batch(&config, &mut generator), &noise(&config, &mut generator)).unwrap();
        }
        agent.state().clone()
    });
    assert_eq!(dac, quad);
}

#[test]
fn bf16_is_close_to_f32() {
    // As wide as one block of AVX-512's columns, so that the CPUs that can do use it.
    let exact = AgentConfig { hidden: 64, ..config(Guidance::Quad) };
    let rounded = AgentConfig { precision: Precision::Bf16, ..exact.clone() };
    let [exact, rounded] = [exact, rounded].map(|config| {
        let mut agent = Agent::from_state(fresh(&config).1, &config, 10, 0);
        let mut generator = ChaCha8Rng::seed_from_u64(7);
        agent.step(&batch(&config, &mut generator), &noise(&config, &mut generator)).unwrap();
        agent.intermediates().targets.clone()
    });
    let difference = exact.iter().zip(&rounded).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max);
    assert_eq!(difference > 0.0, Precision::Bf16.is_available(), "rounding is seen where there is any");
    assert!(difference < 0.02, "targets differ by {difference}");
}

#[test]
fn lambda_stays_within_its_range_for_any_temperature() {
    for tau in [1e-3, 0.1, 1.0, 100.0] {
        let config = AgentConfig { tau, ..config(Guidance::Quad) };
        let mut agent = Agent::from_state(fresh(&config).1, &config, 10, 0);
        let mut generator = ChaCha8Rng::seed_from_u64(5);
        agent.step(&batch(&config, &mut generator), &noise(&config, &mut generator)).unwrap();
        assert!(agent.intermediates().lambda.iter().all(|lambda| *lambda > 0.0 && *lambda <= 1.0), "τ = {tau}");
    }
}

#[test]
fn the_same_seed_gives_the_same_weights() {
    let config = config(Guidance::Quad);
    let run = |seed| {
        let mut agent = Agent::new(config.architecture(DIMS.0, DIMS.1), &config, 10, seed).unwrap();
        let mut generator = ChaCha8Rng::seed_from_u64(6);
        for _ in 0..3 {
            agent.update(&batch(&config, &mut generator)).unwrap();
        }
        agent.target_safetensors().unwrap()
    };
    assert_eq!(run(1), run(1));
    assert_ne!(run(1), run(2));
}

#[test]
fn a_batch_of_other_dimensions_is_refused() {
    let config = config(Guidance::Quad);
    let mut agent = Agent::new(config.architecture(DIMS.0, DIMS.1), &config, 10, 0).unwrap();
    let mut batch = batch(&config, &mut ChaCha8Rng::seed_from_u64(7));
    batch.observations.pop();
    let error = agent.update(&batch).unwrap_err().to_string();
    assert!(error.contains("observations"), "{error}");
}
