//! Tests of every algorithm.

use super::golden::{committed, devices, table};
use super::*;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use candle_core::Device;
use quad_dataset::{Arrays, Transitions, Window};
use quad_nn::Precision;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

mod chunks;
mod evaluation;
mod precision;
mod refusals;

const DIMS: (usize, usize) = (11, 3);
/// A whole run, with each phase of those that have some.
const STEPS: u64 = 10;
/// More than a tile of rows, and no multiple of it.
const BATCH: usize = 150;

fn numbers(generator: &mut ChaCha8Rng, count: usize) -> Vec<f32> {
    (0..count).map(|_| generator.random_range(-1.0..1.0)).collect()
}

/// Random transitions in episodes of ten steps, for some batches.
fn arrays() -> Arrays {
    let (generator, n) = (&mut ChaCha8Rng::seed_from_u64(7), 10 * BATCH);
    let observations = numbers(generator, (n + 1) * DIMS.0);
    Arrays {
        observation_dim: DIMS.0,
        action_dim: DIMS.1,
        actions: numbers(generator, n * DIMS.1),
        rewards: numbers(generator, n),
        next_observations: observations[DIMS.0..].to_vec(),
        observations: observations[..n * DIMS.0].to_vec(),
        terminals: (0..n).map(|row| row % 20 == 9).collect(),
        timeouts: (0..n).map(|row| row % 20 == 19).collect(),
    }
}

fn context(seed: u64, device: &Device) -> Context {
    Context {
        transitions: Arc::new(Transitions::of(arrays()).unwrap()),
        total_steps: STEPS,
        online_steps: 0,
        window: Window::ONE,
        seed,
        precision: Precision::F32,
        device: device.clone(),
        golden: None,
    }
}

/// An algorithm with the hyper-parameters of one of its golden folders, whose networks are small.
struct Variant {
    definition: Definition,
    name: &'static str,
    table: toml::Table,
}

impl Variant {
    fn start(&self, context: &Context) -> Trial {
        let agent = Agent::new(self.definition, &self.table, context.clone()).unwrap();
        let examples = agent.examples(context.transitions.clone()).unwrap();
        Trial { agent, examples }
    }
}

/// An agent and what it learns from.
struct Trial {
    agent: Agent,
    examples: Examples,
}

impl Trial {
    /// The batch of update number `step`.
    fn batch(&self, step: u64) -> Batch {
        let first = step as usize * BATCH;
        let index = |index: usize| (index % self.examples.len()) as u32;
        self.examples.batch(&Vec::from_iter((first..first + BATCH).map(index))).unwrap()
    }

    fn train(&mut self, steps: u64) -> Vec<Vec<Option<f32>>> {
        (0..steps).map(|_| self.agent.update(&self.batch(self.agent.step())).unwrap()).collect()
    }

    fn save(&mut self) -> Vec<u8> {
        self.agent.save().unwrap()
    }

    fn policy(&self) -> Vec<u8> {
        self.agent.policy("here").unwrap()
    }

    /// The tensors of the state whose names begin so, by the rest of the name.
    fn state(&mut self, prefix: &str) -> BTreeMap<String, Vec<f32>> {
        let state = self.agent.algorithm.state_dict().save().unwrap();
        let numbers = |x: candle_core::Tensor| x.flatten_all().unwrap().to_vec1().unwrap();
        let entry = |(name, x): (String, _)| Some((name.strip_prefix(prefix)?.into(), numbers(x)));
        state.into_iter().filter_map(entry).collect()
    }

    /// Multiplies the weights of a network, by the number of that network and its name.
    fn scale(&mut self, factor: impl Fn(usize, &str) -> f64) {
        let networks = self.agent.algorithm.state_dict().networks();
        for (number, (name, weights)) in networks.into_iter().enumerate() {
            let factor = factor(number, &name);
            let scaled = weights.change(|values| values.slice_set(&(values * factor)?, 0, 0));
            scaled.unwrap();
        }
    }
}

fn variants() -> Vec<Variant> {
    let variant = |golden: &golden::Golden| {
        let name = &golden.config["algorithm"];
        let mut definitions = ALGORITHMS.iter();
        let definition = *definitions.find(|definition| name == definition.name)?;
        let (name, table) = (definition.name, table(golden));
        Some(Variant { definition, name, table })
    };
    committed().iter().filter_map(variant).collect()
}

/// The first variant of an algorithm.
fn variant(name: &str) -> Variant {
    let mut variants = variants().into_iter();
    variants.find(|variant| variant.name == name).unwrap()
}

#[test]
fn a_saved_state_resumes_bit_for_bit() {
    let devices = devices();
    for (device, variant) in
        devices.iter().flat_map(|device| variants().into_iter().map(move |one| (device, one)))
    {
        // A whole run, with all its phases; and steps after those from which on all networks move.
        for (first, total_steps) in [(0, STEPS), (1000, 2000)] {
            let (name, mut context) = (variant.name, context(3, device));
            context.total_steps = total_steps;
            let mut straight = variant.start(&context);
            straight.agent.skip_to(first);
            let (mut saved, mut expected) = (Vec::new(), Vec::new());
            for _ in 0..STEPS {
                saved.push(straight.save());
                expected.extend(straight.train(1));
            }
            let end = straight.save();
            assert!(end == straight.save(), "saving is repeatable");
            for (done, saved) in saved.iter().enumerate() {
                let mut resumed = variant.start(&context);
                resumed.agent.load(saved).unwrap();
                assert_eq!(resumed.agent.step(), first + done as u64);
                assert!(resumed.save() == *saved, "{name}");
                let metrics = resumed.train(STEPS - done as u64);
                assert_eq!(metrics, expected[done..], "{name}");
                assert!(resumed.save() == end, "{name}: another state");
            }
        }
    }
}

#[test]
fn weights_are_a_function_of_the_seed() {
    for variant in variants() {
        let run = |seed| {
            let mut trial = variant.start(&context(seed, &Device::Cpu));
            let first = trial.policy();
            trial.train(3);
            [first, trial.policy()]
        };
        let (run_1, run_2) = (run(1), run(2));
        assert!(run_1 == run(1) && run_1[0] != run_1[1]);
        assert!(run_1[0] != run_2[0] && run_1[1] != run_2[1]);
    }
}

#[test]
fn metrics_are_those_of_the_table_and_finite_and_trained_weights_have_gradients() {
    let mut names: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for variant in variants() {
        let (name, mut trial) = (variant.name, variant.start(&context(0, &Device::Cpu)));
        for step in 0..STEPS {
            let batch = trial.batch(step);
            let measured = trial.agent.algorithm.update(step, &batch).unwrap();
            let is_finite = measured.iter().all(|(_, value)| value.is_finite());
            assert!(is_finite, "{measured:?}");
            let metrics = BTreeSet::from_iter(measured.iter().map(|(metric, _)| *metric));
            assert_eq!(metrics.len(), measured.len(), "{name}: {measured:?}");
            names.entry(name).or_default().extend(metrics);
        }
        for (tensor, moment) in trial.state("adam_m") {
            let zeros = moment.iter().filter(|x| **x == 0.0).count();
            // Four of five taps of Diffuser's convolutions see only padding where a window has one
            // step left.
            let most = match name {
                "diffuser" => moment.len() * 4 / 5,
                _ => (moment.len() - 1) / 2,
            };
            let is_finite = moment.iter().all(|x| x.is_finite());
            assert!(is_finite && zeros <= most, "{name}: gradient of {tensor}");
        }
    }
    for Definition { name, metrics, .. } in ALGORITHMS {
        let metrics = metrics.iter().map(|metric| metric.name);
        assert_eq!(names[*name], metrics.collect(), "{name}");
    }
}

/// A NaN among weights reaches a metric, where the training loop sees it, and such a state is not
/// saved.
#[test]
fn a_nan_reaches_a_metric() {
    for variant in variants() {
        let start = || variant.start(&context(0, &Device::Cpu));
        let mut trial = start();
        let networks = trial.agent.algorithm.state_dict().networks();
        let networks = Vec::from_iter(networks.into_iter().map(|(network, _)| network));
        assert!(networks.len() > 1, "{}", variant.name);
        for broken in networks {
            let mut trial = start();
            trial.scale(|_, network| if network == broken { f64::NAN } else { 1.0 });
            let values = trial.train(STEPS).concat();
            // Target networks by which the policy acts, but from which nothing is learned.
            let unread = match variant.name {
                "align-iql" | "diffusion-policy" | "idql" => broken == "target_actor",
                "diffuser" => broken.starts_with("target"),
                "dtql" => broken == "target_critic",
                _ => false,
            };
            let is_seen = values.into_iter().flatten().any(f32::is_nan);
            let name = variant.name;
            assert!(unread || is_seen, "{name}: a NaN in {broken} is lost");
            assert!(trial.agent.save().is_err(), "{name}: {broken} is saved");
        }
    }
}

/// The networks whose optimizers or weights move in each step of a short run.
#[test]
fn each_phase_trains_its_networks() {
    let onestep = toml::toml! { behavior = 4 critic = 2 policy = 4 };
    let dtql = toml::toml! { pretraining = 4 policy = 6 };
    let sfbc = toml::toml! { behavior = 3 critic = 2 planning = 3 };
    let both_policies = "actor critic diffusion value";
    let onestep = (onestep, vec![(0, "behavior"), (4, "critic"), (6, "actor")]);
    let dtql = (dtql, vec![(0, "critic diffusion value"), (4, both_policies)]);
    let sfbc = (sfbc, vec![(0, "actor"), (3, "critic"), (5, ""), (8, "critic")]);
    for (name, (lengths, phases)) in [("onestep", onestep), ("dtql", dtql), ("sfbc", sfbc)] {
        let (phases, expected): (Vec<u64>, Vec<&str>) = phases.into_iter().unzip();
        let mut variant = variant(name);
        variant.table["phases"] = lengths.into();
        let mut trial = variant.start(&context(0, &Device::Cpu));
        assert_eq!(trial.agent.phases(), phases);
        for step in 0..STEPS {
            let before = trial.state("adam_v.");
            trial.train(1);
            let after = trial.state("adam_v.");
            let moved = before.iter().filter(|(tensor, x)| after[*tensor] != **x);
            let networks = moved.map(|(tensor, _)| tensor.split('.').next().unwrap());
            let phase = phases.partition_point(|first| *first <= step) - 1;
            let networks = Vec::from_iter(BTreeSet::from_iter(networks));
            assert_eq!(networks.join(" "), expected[phase], "{name}, step {step}");
        }
    }
}
