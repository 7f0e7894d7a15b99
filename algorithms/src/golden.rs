//! Golden tests: one update of every algorithm, and its policy's actions, against an independent
//! implementation (tests/golden/README.md).

#[path = "../../tests/golden/golden.rs"]
mod reader;

use std::sync::Arc;

use super::ALGORITHMS;
use super::algorithm::Algorithm;
use super::batch::Batch;
use super::context::Context;
use super::definition::{Definition, Metric};
use super::examples::{Columns, Examples};
use super::losses::Measured;
use super::replay::Inputs;
use super::state_dict::StateDict;
use candle_core::{D, DType, Device, NdArray, Tensor};
use quad_dataset::{Arrays, ReadOptions, Transitions, Window};
use quad_nn::{
    NoisePredictor, NoiseShape, Precision, Reverse, Scaling, Tensors, Weights, open_gpu,
};
use quad_policy::{
    Aggregate, EpisodeState, Header, Policy, PolicyConfig, Rule, Samples, load_policy,
};
pub(super) use reader::{Golden, MAKE, committed, fresh, goldens, run};

/// Devices of the tests: the CPU, and a GPU with the feature `cuda`. Without a GPU that half is
/// skipped, unless QUAD_REQUIRE_PEERS=1 asks for one.
#[allow(clippy::print_stderr)]
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

/// Compares metrics and state after an update. Metrics that an update does not measure are 0 in a
/// golden folder. One that is also state, such as η, is compared as state.
pub(super) fn check_update(
    golden: &Golden,
    metrics: &[Metric],
    measured: &Measured,
    state: Tensors,
) {
    for Metric { name, .. } in metrics {
        if golden.expected.contains_key(*name) && !state.contains_key(*name) {
            let value = measured.iter().find(|metric| metric.0 == *name);
            golden.close(name, &tensor(value.map_or(0.0, |metric| metric.1)));
        }
    }
    for (name, tensor) in state {
        golden.close(&name, &tensor);
    }
}

/// Loads all of a golden folder's state.
pub(super) fn load(golden: &Golden, dict: StateDict<'_>) {
    let mut state = golden.state.clone();
    dict.load(&mut state).unwrap();
    let unread = Vec::from_iter(state.keys());
    assert!(unread.is_empty(), "not read: {unread:?}");
}

fn numbers(golden: &Golden, name: &str) -> Vec<f32> {
    let input = golden.inputs[name].to_dtype(DType::F32).unwrap();
    input.flatten_all().unwrap().to_vec1().unwrap()
}

fn tensor(numbers: impl NdArray) -> Tensor {
    Tensor::new(numbers, &Device::Cpu).unwrap()
}

/// The rows of a golden folder as episodes that may go on after a success, read as OGBench's are.
fn episodes(golden: &Golden) -> Transitions {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("golden.npz");
    let names = "observations actions rewards next_observations masks ends";
    let array = |name| (name, golden.input(name, &Device::Cpu));
    let mut arrays = Vec::from_iter(names.split(' ').map(array));
    arrays[5].0 = "terminals";
    Tensor::write_npz(&arrays, &path).unwrap();
    Transitions::read(&path, &ReadOptions::default()).unwrap()
}

/// The transitions of a golden folder's batch: each is an episode, unless the folder says where
/// episodes end.
fn transitions(golden: &Golden) -> Transitions {
    if golden.inputs.contains_key("ends") {
        return episodes(golden);
    }
    let [o, a] = ["/observation_dim", "/action_dim"].map(|dim| golden.count(dim));
    // A folder of plans has no transitions.
    let given = |name: &str, width: usize| match golden.inputs.contains_key(name) {
        true => numbers(golden, name),
        false => vec![1.0; width],
    };
    let flags = |numbers: Vec<f32>, flag| numbers.iter().map(|x| *x == flag).collect();
    let terminals: Vec<bool> = flags(given("masks", 1), 0.0);
    let arrays = Arrays {
        observation_dim: o,
        action_dim: a,
        observations: given("observations", o),
        actions: given("actions", a),
        rewards: given("rewards", 1),
        next_observations: given("next_observations", o),
        timeouts: flags(given("timeouts", terminals.len()), 1.0),
        terminals,
    };
    Transitions::of(arrays).unwrap()
}

/// The batch of a golden folder. Where that says where episodes end, it has windows of steps.
pub(super) fn batch(golden: &Golden, window: Window) -> Batch {
    let indices = Vec::from_iter(0..golden.count("/batch_size") as u32);
    if golden.inputs.contains_key("ends") {
        let transitions = Arc::new(episodes(golden));
        let examples = Examples::new(transitions, Columns::Plain, window).unwrap();
        return examples.batch(&indices).unwrap();
    }
    let given = |name: &str| golden.inputs.get(name).cloned();
    let zeros = Tensor::zeros((indices.len(), 1), DType::F32, &Device::Cpu).unwrap();
    let column = |name: &str| given(name).unwrap_or_else(|| zeros.clone());
    Batch {
        observations: column("observations"),
        actions: column("actions"),
        rewards: column("rewards"),
        next_observations: column("next_observations"),
        masks: column("masks"),
        within: None,
        next_actions: given("next_actions"),
        returns: given("returns"),
        plans: given("windows"),
        indices,
    }
}

pub(super) fn context(golden: &Golden, device: &Device) -> Context {
    Context {
        transitions: Arc::new(transitions(golden)),
        total_steps: golden.count("/total_steps") as u64,
        online_steps: golden.config["online_steps"].as_u64().unwrap_or(0),
        window: Window::ONE,
        seed: 0,
        precision: Precision::F32,
        device: device.clone(),
        golden: Some(Arc::new(golden.inputs.clone())),
    }
}

pub(super) fn table(golden: &Golden) -> toml::Table {
    toml::Table::try_from(&golden.config["agent"]).unwrap()
}

fn check(definition: &Definition, golden: &Golden, device: &Device) {
    let (_, window, start) = definition.read(&table(golden)).unwrap();
    let mut context = context(golden, device);
    context.window = window;
    let mut algorithm = (start.new)(context).unwrap();
    load(golden, algorithm.state_dict());
    check_policy(golden, &*algorithm);
    let mut batch = batch(golden, window);
    if !algorithm.copies_batches() {
        batch = batch.on(device).unwrap();
    }
    let step = golden.count("/step") as u64;
    let measured = algorithm.update(step, &batch).unwrap();
    let state = algorithm.state_dict().save().unwrap();
    check_update(golden, definition.metrics, &measured, state);
}

/// Compares the published policy: its candidates and their values, and its actions.
fn check_policy(golden: &Golden, algorithm: &dyn Algorithm) {
    let name = golden.config["algorithm"].as_str().unwrap();
    let (mut policy, tensors) = algorithm.policy().unwrap();
    if let PolicyConfig::Diffuser { shape, .. } = &mut policy {
        shape.units = Scaling::default();
    }
    let file = Header::new(policy, ()).to_safetensors(&tensors).unwrap();
    let mut policy = load_policy(&file, Precision::F32).unwrap();
    let observations = numbers(golden, "select_observations");
    let n = observations.len() / policy.observation_dim();
    let noise = (!policy.noise().is_empty()).then(|| {
        let noise = &golden.inputs["select_noise"];
        let noise = noise.reshape((policy.noise()[0], n, ())).unwrap();
        let noise = noise.transpose(0, 1).unwrap().flatten_from(1).unwrap();
        noise.to_vec2::<f32>().unwrap()
    });
    let begin = || -> Vec<EpisodeState> {
        let noise = noise.clone().unwrap_or_else(|| vec![Vec::new(); n]);
        noise.into_iter().map(EpisodeState::with_noise).collect()
    };
    if let Some(mut choice) = policy.choice() {
        let candidates = choice.candidates as usize;
        assert_eq!(candidates, golden.count("/agent/candidates"));
        // The folders of all but QUAD have the smaller of the critics' values.
        if name != "quad" {
            choice.aggregate = Aggregate::Min;
        }
        policy = policy.with_choice(choice).unwrap();
        let sample = |policy: &dyn Policy| policy.sample(&observations, &mut begin()).unwrap();
        let Samples { actions, values } = sample(&*policy);
        let values = tensor(values);
        // A planner has more candidates than first actions, and QUAD's folders have none.
        if !["diffuser", "quad"].contains(&name) {
            golden.close("select.candidates", &tensor(actions));
        }
        let values_name = match name {
            "diffuser" => "select.values",
            _ => "select.q",
        };
        golden.close(values_name, &values);
        if let Rule::Softmax { temperature } = choice.rule {
            let q = (values.reshape((n, ())).unwrap() / f64::from(temperature)).unwrap();
            let probabilities = candle_nn::ops::softmax(&q, D::Minus1).unwrap();
            golden.close("select.probabilities", &probabilities);
        }
        if golden.inputs.contains_key("select_guidance") {
            choice.guidance = numbers(golden, "select_guidance")[0];
            let guided = policy.with_choice(choice).unwrap();
            golden.close("select.guided", &tensor(sample(&*guided).actions));
        }
    }
    if golden.expected.contains_key("select.actions") {
        let mut actions = vec![0.0; n * policy.action_dim()];
        let acted = policy.act(&observations, &mut begin(), &mut actions);
        acted.unwrap();
        golden.close("select.actions", &tensor(actions));
    }
}

fn check_all(goldens: &[Golden]) {
    for golden in goldens {
        let name = golden.config["algorithm"].as_str().unwrap();
        let definition = ALGORITHMS.iter().find(|definition| definition.name == name);
        if let Some(definition) = definition {
            devices().iter().for_each(|device| check(definition, golden, device));
        }
    }
}

#[test]
fn golden_update() {
    for Definition { name, .. } in ALGORITHMS {
        let goldens = goldens(name);
        check_all(&goldens);
        let one = std::env::var_os("GOLDEN_DIR").is_some();
        assert!(one || !goldens.is_empty(), "there are no golden folders of {name}");
    }
}

/// The reverse steps of QUAD's target actor, each by itself.
#[test]
fn golden_reverse_steps() -> candle_core::Result<()> {
    for golden in goldens("quad") {
        let shape = NoiseShape {
            observation_dim: golden.count("/observation_dim"),
            action_dim: golden.count("/action_dim"),
            layers: serde_json::from_value(golden.config["agent"]["actor"].clone()).unwrap(),
            diffusion_steps: golden.count("/agent/diffusion_steps"),
            reverse: Reverse::ClipClean,
        };
        let mut state = golden.state.clone();
        let weights = Weights::take(shape.layout(), &mut state, "target_actor.").unwrap();
        let actor = NoisePredictor::new(shape.clone(), weights, Precision::F32);
        let input = |name| golden.input(name, &Device::Cpu);
        let (observations, actions) = (input("observations"), input("denoise_actions"));
        let (mut clean, mut mean) = (Vec::new(), Vec::new());
        for t in 1..=shape.diffusion_steps {
            let x = actions.get(t - 1)?;
            let steps = Tensor::full(t as u32, x.dim(0)?, &Device::Cpu)?;
            let epsilon = actor.predict(&observations, &x, &steps)?;
            clean.push(actor.schedule().clean(t, &x, &epsilon)?);
            mean.push(actor.schedule().reverse(t, &x, &epsilon, None)?);
        }
        golden.close("denoise.x0", &Tensor::stack(&clean, 0)?);
        golden.close("denoise.mean", &Tensor::stack(&mean, 0)?);
    }
    Ok(())
}

#[test]
fn golden_update_of_a_fresh_seed() {
    check_all(&fresh());
}

#[test]
fn golden_folders_are_what_their_script_makes() {
    run(MAKE, &["--check"]);
}

/// The JAX program that `deploy/bench.sh` compares with does the same work.
#[test]
fn golden_peer_of_the_benchmarks() {
    run("algorithms/benches/jax_step.py", &["--check"]);
}
