//! What the golden tests of all algorithms share (tests/golden/README.md).

#[path = "../../tests/golden/golden.rs"]
mod reader;

use std::sync::Arc;

use super::algorithm::{Algorithm, Measured, smaller};
use super::context::{Context, Minibatch};
use super::definition::{Definition, Metric};
use super::denoising::Denoising;
use super::parts::Parts;
use candle_core::{Device, Tensor};
use quad_dataset::{Arrays, Transitions};
use quad_nn::{
    Ensemble, EnsembleShape, Layout, NoisePredictor, Precision, Reverse, Schedule, Tensors,
    Weights, open_gpu,
};
use quad_policy::{
    Choice, Header, OneStepActor, PolicyConfig, SquashedActor, load_policy, read_tensors,
};
pub(super) use reader::{Golden, MAKE, goldens, run};

/// Tests an update against the folders of an algorithm, on each device; and against one of a fresh
/// seed of each of its variants.
macro_rules! golden_tests {
    ($algorithm:literal, $check:expr) => {
        #[test]
        fn golden_update() {
            crate::golden::check_all(crate::golden::goldens($algorithm), $check);
        }

        #[test]
        fn golden_update_of_a_fresh_seed() {
            crate::golden::check_all(crate::golden::fresh_ones($algorithm), $check);
        }
    };
}
pub(super) use golden_tests;

pub(super) fn check_all(goldens: Vec<Golden>, check: impl Fn(&Golden, &Device)) {
    goldens.iter().for_each(|golden| devices().iter().for_each(|device| check(golden, device)));
}

/// Folders of a fresh seed, one for each committed one; fewer where make.py cannot run.
pub(super) fn fresh_ones(algorithm: &str) -> Vec<Golden> {
    let name = |golden: &Golden| golden.folder.file_name().unwrap().to_str().unwrap().to_owned();
    reader::committed(algorithm).iter().filter_map(|golden| reader::fresh(&name(golden))).collect()
}

/// Where updates are tested: on the CPU, and on a GPU with the feature `cuda`. Without a GPU that
/// share is skipped, unless QUAD_REQUIRE_PEERS=1 asks for one.
#[allow(clippy::print_stderr)] // what is skipped is said
pub(super) fn devices() -> Vec<Device> {
    let mut devices = vec![Device::Cpu];
    if cfg!(feature = "cuda") {
        match open_gpu() {
            Ok(gpu) => devices.push(gpu),
            Err(error) => {
                let required =
                    std::env::var_os("QUAD_REQUIRE_PEERS").is_some_and(|value| value == "1");
                assert!(!required, "there is no GPU: {error}");
                eprintln!("skipped on CUDA, because there is no GPU: {error}");
            }
        }
    }
    devices
}

/// What an update measured under a name.
pub(super) fn value(measured: &Measured, name: &str) -> Option<f32> {
    measured.iter().find(|(known, _)| *known == name).map(|(_, value)| *value)
}

/// Checks that an update gave what a golden folder expects: each metric and each tensor of the
/// state. What the folder's update does not measure is 0 there.
pub(super) fn check_update(
    golden: &Golden,
    metrics: &[Metric],
    measured: &Measured,
    state: Tensors,
) {
    for Metric { name, .. } in
        metrics.iter().filter(|metric| golden.expected.contains_key(metric.name))
    {
        golden
            .close(name, &Tensor::new(value(measured, name).unwrap_or(0.0), &Device::Cpu).unwrap());
    }
    for (name, tensor) in state {
        golden.close(&name, &tensor);
    }
}

/// Loads the state of a golden folder, all of it.
pub(super) fn load(golden: &Golden, parts: Parts<'_>) {
    let mut state = golden.state.clone();
    parts.load(&mut state).unwrap();
    assert!(state.is_empty(), "tensors that are not read: {:?}", state.keys());
}

/// The context of a golden folder, whose transitions are those of its batch.
pub(super) fn context(golden: &Golden, device: &Device) -> Context {
    let numbers = |name: &str| {
        golden.input(name, &Device::Cpu).flatten_all().unwrap().to_vec1::<f32>().unwrap()
    };
    let terminals: Vec<bool> = numbers("masks").iter().map(|mask| *mask == 0.0).collect();
    let arrays = Arrays {
        observation_dim: golden.count("/observation_dim"),
        action_dim: golden.count("/action_dim"),
        observations: numbers("observations"),
        actions: numbers("actions"),
        rewards: numbers("rewards"),
        next_observations: numbers("next_observations"),
        // Unless it is said, none leads to the next: they are rows at random.
        timeouts: match golden.inputs.contains_key("timeouts") {
            true => numbers("timeouts").iter().map(|timeout| *timeout == 1.0).collect(),
            false => vec![true; terminals.len()],
        },
        terminals,
    };
    Context {
        transitions: Arc::new(Transitions::of(arrays).unwrap()),
        batch_size: golden.count("/batch_size"),
        total_steps: golden.count("/total_steps") as u64,
        seed: 0,
        precision: Precision::F32,
        device: device.clone(),
    }
}

/// The hyper-parameters of a golden folder.
pub(super) fn table(golden: &Golden) -> toml::Table {
    toml::Table::try_from(&golden.config["agent"]).unwrap()
}

/// The noise of sampled actions, `[T, states, samples, a]` in a golden folder, one row for each
/// action.
pub(super) fn chain_noise(golden: &Golden, name: &str, device: &Device) -> Tensor {
    golden.input(name, device).flatten(1, golden.inputs[name].rank() - 2).unwrap()
}

/// How a golden folder makes the actions of its batch noisy.
pub(super) fn denoising(golden: &Golden, device: &Device) -> Denoising {
    let t: Vec<i64> = golden.inputs["t"].to_vec1().unwrap();
    let t: Vec<u32> = t.into_iter().map(|t| t as u32).collect();
    let schedule =
        Schedule::variance_preserving(golden.count("/agent/diffusion_steps"), Reverse::ClipClean);
    Denoising::new(&t, golden.input("epsilon", device), &schedule).unwrap()
}

/// The batch of a golden folder.
pub(super) fn batch(golden: &Golden, context: &Context) -> Minibatch {
    context.batch(&items(golden)).unwrap()
}

/// The numbers of its items.
pub(super) fn items(golden: &Golden) -> Vec<u32> {
    (0..golden.count("/batch_size") as u32).collect()
}

/// Checks an update without random numbers.
pub(super) fn check_definition(definition: &Definition, golden: &Golden, device: &Device) {
    let mut algorithm = (definition.start)(&table(golden), context(golden, device)).unwrap();
    load(golden, algorithm.parts());
    check_actions(golden, &*algorithm);
    let measured = algorithm.update(golden.count("/step") as u64, &items(golden)).unwrap();
    check_update(golden, definition.metrics, &measured, algorithm.parts().save().unwrap());
}

/// Checks that a policy that draws nothing acts as a golden folder expects.
pub(super) fn check_actions(golden: &Golden, algorithm: &dyn Algorithm) {
    let (policy, tensors) = algorithm.policy().unwrap();
    let file = Header::new(policy, ()).to_safetensors(&tensors).unwrap();
    let policy = load_policy(&file, Precision::F32).unwrap();
    let observations = golden.input("select_observations", &Device::Cpu);
    let mut states: Vec<_> =
        (0..observations.dim(0).unwrap() as u64).map(|seed| policy.begin(seed)).collect();
    let observations: Vec<f32> = observations.flatten_all().unwrap().to_vec1().unwrap();
    let mut actions = vec![0.0; states.len() * policy.action_dim()];
    policy.act(&observations, &mut states, &mut actions).unwrap();
    golden.close("select.actions", &Tensor::new(actions, &Device::Cpu).unwrap());
}

/// What a published policy that draws candidates makes of a golden folder's states and noise.
pub(super) struct Drawn {
    pub choice: Choice,
    /// Candidates, `[states · N_a, a]`.
    pub candidates: Tensor,
    /// The smaller of the critics' values of each, `[states, N_a]`.
    pub q: Tensor,
    /// V of each state, if the policy has it, `[states]`.
    pub v: Option<Tensor>,
}

/// Checks that the networks of a published policy draw and value candidates as a golden folder
/// expects.
pub(super) fn check_candidates(golden: &Golden, algorithm: &dyn Algorithm) -> Drawn {
    let (policy, tensors) = algorithm.policy().unwrap();
    let file = Header::new(policy.clone(), ()).to_safetensors(&tensors).unwrap();
    load_policy(&file, Precision::F32).unwrap();
    let mut tensors = read_tensors(&file).unwrap();
    let mut weights =
        |layout: Layout, prefix: &str| Weights::take(layout, &mut tensors, prefix).unwrap();
    let ensemble = |of: EnsembleShape, weights: Weights| Ensemble::new(of, weights, Precision::F32);
    let observations = golden.input("select_observations", &Device::Cpu);
    let noise = chain_noise(golden, "select_noise", &Device::Cpu);
    let (choice, candidates, critics, value) = match policy {
        PolicyConfig::Diffusion { shape, choice } => {
            let actor = NoisePredictor::new(
                shape.actor(),
                weights(shape.actor().layout(), "actor."),
                Precision::F32,
            );
            let value =
                shape.value().map(|of| ensemble(of.clone(), weights(of.layout(), "value.")));
            (choice, actor.sample(&observations, &noise), shape.critics(), value)
        }
        PolicyConfig::Squashed { shape, choice } => {
            let of = SquashedActor::shape(&shape);
            let actor = SquashedActor::new(ensemble(of.clone(), weights(of.layout(), "actor.")));
            (choice, actor.sample(&observations, &noise.squeeze(0).unwrap()), shape.critics(), None)
        }
        PolicyConfig::OneStep { shape, choice } => {
            let of = OneStepActor::shape(&shape);
            let actor = OneStepActor::new(ensemble(of.clone(), weights(of.layout(), "actor.")));
            (choice, actor.sample(&observations, &noise.squeeze(0).unwrap()), shape.critics(), None)
        }
        other => panic!("{other:?}"),
    };
    let (candidates, critics) =
        (candidates.unwrap(), ensemble(critics.clone(), weights(critics.layout(), "critic.")));
    let q = smaller(&critics.values(&observations, &candidates).unwrap()).unwrap();
    golden.close("select.candidates", &candidates);
    golden.close("select.q", &q);
    let q = q.reshape((observations.dim(0).unwrap(), ())).unwrap();
    let v = value.map(|value| value.state_values(&observations).unwrap().squeeze(0).unwrap());
    Drawn { choice, candidates, q, v }
}
