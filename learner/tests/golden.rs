//! The fast update and the reference against numbers from an independent implementation, tests/golden/make.py.
//!
//! The folders' format is in docs/golden.md. `GOLDEN_DIR=FOLDER` reads another folder in place of the committed ones.

#![allow(clippy::unwrap_used)] // what cannot be had ends the run

mod devices;

use candle_core::Device;
use devices::devices;
use quad_dataset::Batch;
use quad_learner::agent::reference::{Reference, ReferenceState};
use quad_learner::agent::{Agent, AgentConfig, AgentState, Guidance, Moments, StepMetrics, StepNoise};
use quad_policy::{Architecture, NoisePredictor, NoisyActions, Parameters, Precision, Schedule, TargetPolicy};
use safetensors::{Dtype, SafeTensors};
use std::path::{Path, PathBuf};

/// Largest error, relative to the number itself or, for numbers near zero, to their tensor's root mean square.
const TOLERANCE: f32 = 1e-4;

#[derive(serde::Deserialize)]
struct Config {
    observation_dim: usize,
    action_dim: usize,
    candidates: usize,
    total_steps: u64,
    step: u64,
    agent: AgentConfig,
}

/// A golden folder.
struct Golden {
    folder: PathBuf,
    config: Config,
    architecture: Architecture,
    state: Vec<u8>,
    inputs: Vec<u8>,
    expected: Vec<u8>,
}

fn read(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

impl Golden {
    fn open(folder: PathBuf) -> Self {
        let config: Config = serde_json::from_slice(&read(&folder.join("config.json"))).unwrap();
        let architecture = config.agent.architecture(config.observation_dim, config.action_dim);
        let file = |name: &str| read(&folder.join(name).with_extension("safetensors"));
        let (state, inputs, expected) = (file("state"), file("inputs"), file("expected"));
        Self { folder, config, architecture, state, inputs, expected }
    }

    fn parameters(&self, bytes: &[u8], prefix: &str) -> Parameters {
        Parameters::read(&self.architecture, &SafeTensors::deserialize(bytes).unwrap(), prefix).unwrap()
    }

    fn agent_state(&self) -> AgentState {
        let (first, second) = (self.parameters(&self.state, "adam_m."), self.parameters(&self.state, "adam_v."));
        let nu_squared = numbers(&self.state, "nu_squared")[0];
        AgentState {
            online: self.parameters(&self.state, ""),
            target: self.parameters(&self.state, "target_"),
            actor_moments: Moments { first: first.actor, second: second.actor },
            critic_moments: Moments { first: first.critics, second: second.critics },
            eta: numbers(&self.state, "eta")[0],
            nu_squared: (nu_squared >= 0.0).then_some(nu_squared),
            step: self.config.step,
        }
    }

    fn batch(&self) -> Batch {
        let input = |name: &str| numbers(&self.inputs, name);
        Batch {
            observations: input("observations"),
            actions: input("actions"),
            rewards: input("rewards"),
            next_observations: input("next_observations"),
            masks: input("masks"),
            size: self.config.agent.batch_size,
        }
    }

    fn noise(&self) -> StepNoise {
        StepNoise {
            next: numbers(&self.inputs, "next_noise"),
            t: whole_numbers(&self.inputs, "t"),
            epsilon: numbers(&self.inputs, "epsilon"),
        }
    }

    fn close(&self, name: &str, found: &[f32]) {
        close(&format!("{} {name}", self.folder.display()), found, &numbers(&self.expected, name));
    }

    fn check_metrics(&self, metrics: &StepMetrics) {
        self.close("critic_loss", &[metrics.critic_loss]);
        self.close("critic_gradient_norm", &[metrics.critic_gradient_norm]);
        self.close("bc_loss", &[metrics.bc_loss]);
        self.close("actor_loss", &[metrics.actor_loss]);
        self.close("actor_gradient_norm", &[metrics.actor_gradient_norm]);
        self.close("eta", &[metrics.eta]);
        if self.config.agent.guidance != Guidance::None {
            self.close("nu_squared", &[metrics.nu_squared]);
        }
    }
}

fn goldens() -> Vec<Golden> {
    if let Some(folder) = std::env::var_os("GOLDEN_DIR") {
        return vec![Golden::open(folder.into())];
    }
    let home = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden");
    let mut folders: Vec<_> = std::fs::read_dir(&home).unwrap().map(|entry| entry.unwrap().path()).collect();
    folders.retain(|folder| folder.join("config.json").exists());
    folders.sort();
    assert!(folders.len() >= 3, "the committed golden folders are missing from {}", home.display());
    folders.into_iter().map(Golden::open).collect()
}

fn numbers(bytes: &[u8], name: &str) -> Vec<f32> {
    let file = SafeTensors::deserialize(bytes).unwrap();
    let tensor = file.tensor(name).unwrap_or_else(|_| panic!("no tensor {name:?}"));
    assert_eq!(tensor.dtype(), Dtype::F32, "{name}");
    tensor.data().chunks_exact(4).map(|x| f32::from_le_bytes(x.try_into().unwrap())).collect()
}

fn whole_numbers(bytes: &[u8], name: &str) -> Vec<usize> {
    let file = SafeTensors::deserialize(bytes).unwrap();
    let tensor = file.tensor(name).unwrap_or_else(|_| panic!("no tensor {name:?}"));
    assert_eq!(tensor.dtype(), Dtype::I64, "{name}");
    tensor.data().chunks_exact(8).map(|x| i64::from_le_bytes(x.try_into().unwrap()) as usize).collect()
}

fn root_mean_square(x: &[f32]) -> f32 {
    (x.iter().map(|x| x * x).sum::<f32>() / x.len() as f32).sqrt()
}

fn close(name: &str, found: &[f32], expected: &[f32]) {
    assert_eq!(found.len(), expected.len(), "{name}: how many");
    let scale = root_mean_square(expected);
    for (i, (found, expected)) in found.iter().zip(expected).enumerate() {
        let bound = TOLERANCE * expected.abs().max(scale);
        assert!((found - expected).abs() <= bound, "{name}[{i}] is {found}, expected {expected}");
    }
}

/// What an update moved, held against what it should have moved: far stricter than the weights themselves.
fn close_movement(name: &str, before: &[f32], found: &[f32], expected: &[f32]) {
    close(name, found, expected);
    let movement = |after: &[f32]| after.iter().zip(before).map(|(x, y)| x - y).collect::<Vec<_>>();
    let (found, expected) = (movement(found), movement(expected));
    // Rounding of the weights themselves (about 1e-7 of each) is not the update's.
    let bound = 10.0 * TOLERANCE * root_mean_square(&expected) + 1e-6 * root_mean_square(before);
    for (i, (found, expected)) in found.iter().zip(&expected).enumerate() {
        assert!((found - expected).abs() <= bound, "{name}[{i}] moved by {found}, expected {expected}");
    }
}

#[test]
fn golden_schedule() {
    for golden in goldens() {
        let schedule = Schedule::variance_preserving(golden.architecture.diffusion_steps);
        golden.close("schedule.beta", &schedule.beta);
        golden.close("schedule.alpha_bar", &schedule.alpha_bar);
    }
}

#[test]
fn golden_denoise_step() {
    for golden in goldens() {
        let target = golden.agent_state().target;
        let actor = NoisePredictor::new(&golden.architecture);
        let (batch, starts) = (golden.batch(), numbers(&golden.inputs, "denoise_actions"));
        let mut means = Vec::new();
        for (i, start) in starts.chunks(batch.actions.len()).enumerate() {
            let (mut x, mut epsilon) = (start.to_vec(), vec![0.0; start.len()]);
            let t = vec![i + 1; batch.size];
            let noisy = NoisyActions { observations: &batch.observations, actions: start, t: &t };
            actor.predict(&target.actor, noisy, &mut epsilon);
            actor.schedule().reverse(i + 1, &mut x, &epsilon, &vec![0.0; start.len()]);
            means.extend(x);
        }
        golden.close("denoise.mean", &means);
    }
}

#[test]
fn golden_best_of_candidates() {
    for golden in goldens() {
        let policy = TargetPolicy::new(golden.agent_state().target, Precision::F32);
        let states = numbers(&golden.inputs, "select_observations");
        let candidates = golden.config.candidates;
        let selection = policy.select_with(&states, candidates, &numbers(&golden.inputs, "select_noise"));
        golden.close("select.q", &selection.values);
        assert_eq!(selection.chosen, whole_numbers(&golden.expected, "select.index"));
        let a = golden.architecture.action_dim;
        let chosen = selection.chosen.iter().enumerate().flat_map(|(i, chosen)| {
            let at = (i * candidates + chosen) * a;
            selection.candidates[at..at + a].to_vec()
        });
        golden.close("select.actions", &chosen.collect::<Vec<_>>());
    }
}

#[test]
fn golden_update() {
    for golden in goldens() {
        let before = golden.agent_state();
        let mut agent = Agent::from_state(before.clone(), &golden.config.agent, golden.config.total_steps, 0);
        let metrics = agent.step(&golden.batch(), &golden.noise()).unwrap();
        golden.check_metrics(&metrics);

        let seen = agent.intermediates();
        golden.close("next_actions", &seen.next_actions);
        golden.close("targets", &seen.targets);
        golden.close("noisy_actions", &seen.noisy_actions);
        if golden.config.agent.guidance != Guidance::None {
            golden.close("q_scale", &[seen.q_scale]);
            let raw: Vec<f32> = seen.action_gradients.iter().map(|g| g * seen.q_scale).collect();
            golden.close("critic_action_gradients", &raw);
            golden.close("u", &seen.uncertainty.direction);
            golden.close("sigma_squared", &seen.uncertainty.variance);
            golden.close("lambda", &seen.lambda);
            assert!(seen.lambda.iter().all(|lambda| *lambda > 0.0 && *lambda <= 1.0));
        }

        let (after, online) = (agent.state(), golden.parameters(&golden.expected, ""));
        let target = golden.parameters(&golden.expected, "target_");
        let (first, second) =
            (golden.parameters(&golden.expected, "adam_m."), golden.parameters(&golden.expected, "adam_v."));
        close_movement("actor", &before.online.actor, &after.online.actor, &online.actor);
        close_movement("critics", &before.online.critics, &after.online.critics, &online.critics);
        close_movement("target actor", &before.target.actor, &after.target.actor, &target.actor);
        close_movement("target critics", &before.target.critics, &after.target.critics, &target.critics);
        close_movement("actor's m", &before.actor_moments.first, &after.actor_moments.first, &first.actor);
        close_movement("actor's v", &before.actor_moments.second, &after.actor_moments.second, &second.actor);
        close_movement("critics' m", &before.critic_moments.first, &after.critic_moments.first, &first.critics);
        close_movement("critics' v", &before.critic_moments.second, &after.critic_moments.second, &second.critics);
    }
}

#[test]
fn golden_reference_update() {
    for device in devices() {
        golden_reference_update_on(&device);
    }
}

/// Any device must meet the same tolerance: candle multiplies in full f32 on a GPU, too, unless it is told to use TF32,
/// so that only the order of sums differs.
fn golden_reference_update_on(device: &Device) {
    for golden in goldens() {
        let mut state = ReferenceState::new(&golden.agent_state(), device).unwrap();
        let update = Reference {
            config: &golden.config.agent,
            architecture: golden.architecture,
            total_steps: golden.config.total_steps,
            device: device.clone(),
        };
        let metrics = update.step(&mut state, &golden.batch(), &golden.noise()).unwrap();
        golden.check_metrics(&metrics);
        for (prefix, tensors) in [
            ("", &state.actor),
            ("", &state.critics),
            ("target_", &state.target_actor),
            ("target_", &state.target_critics),
            ("adam_m.", &state.first),
            ("adam_v.", &state.second),
        ] {
            for (name, tensor) in tensors {
                let found = tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
                golden.close(&format!("{prefix}{name}"), &found);
            }
        }
    }
}
