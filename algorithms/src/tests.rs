//! Tests of what every algorithm must do, and of the tables that derive from it.

use super::golden::{MAKE, devices, goldens, run, table};
use super::*;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use candle_core::Device;
use quad_dataset::{Arrays, Transitions};
use quad_nn::Precision;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

mod evaluation;

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
        batch_size: BATCH,
        total_steps: STEPS,
        seed,
        precision: Precision::F32,
        device: device.clone(),
    }
}

/// Every algorithm with the hyper-parameters of each of its golden folders, whose networks are
/// small.
fn variants() -> Vec<(Definition, toml::Table)> {
    let of = |known: Definition| {
        goldens(known.name).into_iter().map(move |golden| (known, table(&golden)))
    };
    ALGORITHMS.into_iter().flat_map(of).collect()
}

fn agent(definition: Definition, table: &toml::Table, context: &Context) -> Agent {
    Agent::new(definition, table, context.clone()).unwrap()
}

/// The items of update number `step`.
fn items(step: u64, agent: &Agent) -> Vec<u32> {
    let first = step as usize * BATCH;
    (first..first + BATCH).map(|item| (item % agent.items()) as u32).collect()
}

fn train(agent: &mut Agent, steps: u64) -> Vec<Vec<Option<f32>>> {
    (0..steps).map(|_| agent.update(&items(agent.step(), agent)).unwrap()).collect()
}

#[test]
fn a_saved_state_goes_on_bit_for_bit() {
    for (device, (definition, table)) in
        devices().iter().flat_map(|device| variants().into_iter().map(move |v| (device, v)))
    {
        // A whole run, with all its phases; and steps after those from which on all networks move.
        for (first, total_steps) in [(0, STEPS), (1000, 2000)] {
            let context = Context { total_steps, ..context(3, device) };
            let mut straight = agent(definition, &table, &context);
            straight.skip_to(first);
            let (mut saved, mut expected) = (Vec::new(), Vec::new());
            for _ in 0..STEPS {
                saved.push(straight.save().unwrap());
                expected.extend(train(&mut straight, 1));
            }
            let end = straight.save().unwrap();
            assert!(end == straight.save().unwrap(), "saving is repeatable");
            for (done, saved) in saved.iter().enumerate() {
                let mut resumed = agent(definition, &table, &context);
                resumed.load(saved).unwrap();
                assert_eq!(
                    (resumed.step(), resumed.save().unwrap() == *saved),
                    (first + done as u64, true)
                );
                assert_eq!(
                    train(&mut resumed, STEPS - done as u64),
                    expected[done..],
                    "{}",
                    definition.name
                );
                assert!(resumed.save().unwrap() == end, "{}: another state", definition.name);
            }
        }
    }
}

#[test]
fn a_state_that_does_not_fit_is_refused() {
    let mut variants = variants().into_iter();
    let one = variants.next().unwrap();
    let other = variants.find(|(known, _)| known.name != one.0.name).unwrap();
    let context = context(3, &Device::Cpu);
    let saved = agent(one.0, &one.1, &context).save().unwrap();
    let refused = |definition, table: &toml::Table, bytes: &[u8]| {
        agent(definition, table, &context).load(bytes).unwrap_err().to_string()
    };
    let foreign = refused(other.0, &other.1, &saved);
    assert!(foreign.contains(one.0.name) && foreign.contains(other.0.name), "{foreign}");
    let mut wider = one.1.clone();
    let mut networks = wider.iter_mut().filter_map(|(_, value)| value.get_mut("hidden"));
    *networks.next().unwrap() = vec![25].into();
    let shape = refused(one.0, &wider, &saved);
    assert!(shape.contains("shape"), "{shape}");
    for bytes in [&b""[..], b"nonsense", &saved[..saved.len() - 1]] {
        assert!(!refused(one.0, &one.1, bytes).is_empty());
    }
    let policy = agent(one.0, &one.1, &context).policy("here").unwrap();
    assert!(refused(one.0, &one.1, &policy).contains("`state`"));
}

#[test]
fn the_seed_alone_decides_the_weights() {
    for (definition, table) in variants() {
        let run = |seed| {
            let context = context(seed, &Device::Cpu);
            let mut agent = agent(definition, &table, &context);
            let first = agent.policy("here").unwrap();
            train(&mut agent, 3);
            (first, agent.policy("here").unwrap())
        };
        let (first, last) = run(1);
        assert!((first.clone(), last.clone()) == run(1) && first != last);
        let (other_first, other_last) = run(2);
        assert!(first != other_first && last != other_last);
    }
}

/// What updates measure is in the algorithm's table, once each, and nothing else is there.
#[test]
fn a_metric_has_the_same_name_where_it_is_computed_and_in_the_table() {
    let mut found: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for (definition, table) in variants() {
        let mut algorithm = (definition.start)(&table, context(0, &Device::Cpu)).unwrap();
        for step in 0..STEPS {
            let measured = algorithm.update(step, &Vec::from_iter(0..BATCH as u32)).unwrap();
            let names = BTreeSet::from_iter(measured.iter().map(|(name, _)| *name));
            assert_eq!(names.len(), measured.len(), "{}: {measured:?}", definition.name);
            found.entry(definition.name).or_default().extend(names);
        }
    }
    for Definition { name, metrics, .. } in ALGORITHMS {
        assert_eq!(found[name], metrics.iter().map(|metric| metric.name).collect(), "{name}");
    }
}

#[test]
fn every_value_is_finite_and_every_weight_that_is_trained_has_a_gradient() {
    for (definition, table) in variants() {
        let mut agent = agent(definition, &table, &context(0, &Device::Cpu));
        for values in train(&mut agent, STEPS) {
            assert!(values.iter().flatten().all(|value| value.is_finite()), "{values:?}");
        }
        for (name, moment) in
            agent.parts().save().unwrap().iter().filter(|(name, _)| name.starts_with("adam_m"))
        {
            let moment: Vec<f32> = moment.flatten_all().unwrap().to_vec1().unwrap();
            let zeros = moment.iter().filter(|x| **x == 0.0).count();
            // Where a window has one step left, four of five taps of Diffuser's convolutions see
            // only what is beside it.
            let most = if definition.name == "diffuser" {
                moment.len() * 4 / 5
            } else {
                (moment.len() - 1) / 2
            };
            let good = moment.iter().all(|x| x.is_finite()) && zeros <= most;
            assert!(good, "{}: {name} has a gradient that is 0 or not finite", definition.name);
        }
    }
}

/// Weights that are not a number end up in a metric, where the training loop sees it, whatever
/// maximum or minimum they went through; and neither such a state nor such a policy is handed over.
#[test]
fn a_nan_is_never_dropped() {
    for (definition, table) in variants() {
        let count = agent(definition, &table, &context(0, &Device::Cpu)).parts().networks().len();
        assert!(count > 1, "{}", definition.name);
        for network in 0..count {
            let mut agent = agent(definition, &table, &context(0, &Device::Cpu));
            let (name, weights) = agent.parts().networks().swap_remove(network);
            weights.change(|values| values.slice_set(&(values * f64::NAN)?, 0, 0)).unwrap();
            let values = train(&mut agent, STEPS);
            // By these the policy acts, but nothing is learned from them: they are averages of
            // networks that are watched.
            let unread = match definition.name {
                "align-iql" | "idql" => name == "target_actor",
                "diffuser" => name.starts_with("target"),
                "dtql" => name == "target_critic",
                _ => false,
            };
            assert!(
                unread || values.iter().flatten().flatten().any(|value| value.is_nan()),
                "{}: a NaN in {name} is lost",
                definition.name
            );
            assert!(agent.save().is_err(), "{}: a broken state is saved", definition.name);
        }
    }
}

#[test]
fn a_hyper_parameter_that_is_refused_is_named() {
    for definition in ALGORITHMS {
        let Some(toml::Value::Table(agent)) =
            Values::of(&definition).for_task(None).remove("agent")
        else {
            panic!("{} has no values", definition.name)
        };
        for key in agent.keys().filter(|key| agent[*key].is_float()) {
            let mut changed = agent.clone();
            changed.insert(key.clone(), "much".into());
            let error = (definition.check)(&changed).unwrap_err().to_string();
            assert!(error.contains(&format!("in `{key}`")), "{} {key}: {error}", definition.name);
            changed.remove(key);
            let error = (definition.check)(&changed).unwrap_err().to_string();
            assert!(
                error.contains(&format!("missing field `{key}`")),
                "{} {key}: {error}",
                definition.name
            );
        }
    }
}

#[test]
fn metric_names_are_prometheus_names_and_distinct() {
    for definition in ALGORITHMS {
        let mut names: Vec<_> = definition.metrics.iter().map(|metric| metric.name).collect();
        assert!(
            names.iter().all(|name| name
                .chars()
                .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')),
            "{names:?}"
        );
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), definition.metrics.len(), "{}", definition.name);
    }
}

#[test]
fn golden_folders_are_what_their_script_makes() {
    run(MAKE, &["--check"]);
}
