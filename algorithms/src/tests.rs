//! Tests of what every algorithm must do, and of the tables that derive from it.

use super::golden::{MAKE, devices, run};
use super::*;
use std::mem;
use std::sync::Arc;

use candle_core::Device;
use quad_dataset::{Arrays, Transitions};
use quad_policy::Precision;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use toml::{Value, toml};

const DIMS: (usize, usize) = (11, 3);
const STEPS: u64 = 50;
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

/// Every algorithm as the demonstration has it, and variants of some, with small networks.
fn variants() -> Vec<(Definition, toml::Table)> {
    let mut variants = Vec::new();
    let guided = |guidance: &str| ("quad", toml! { agent.guidance = guidance });
    let of_quad = ["quad", "dac", "none", "mean", "shuffled"].map(guided);
    let constant = ("quad", toml! { agent.guidance = "constant" agent.lambda = 0.5 });
    let others = ALGORITHMS.iter().filter(|known| known.name != "quad").map(|known| (known.name, toml::Table::new()));
    let of_ivr = [("ivr", toml! { agent.divergence = "exponential" })];
    for (algorithm, changes) in of_quad.into_iter().chain([constant]).chain(others).chain(of_ivr) {
        let definition = ALGORITHMS.into_iter().find(|known| known.name == algorithm).unwrap();
        let mut experiment = Values::of(&definition).unwrap().for_task(Some("hopper-demo"));
        merge(&mut experiment, changes);
        let agent = experiment["agent"].as_table_mut().unwrap();
        for (key, value) in &mut *agent {
            match (&**key, value) {
                ("actor" | "critic" | "value" | "behavior", Value::Table(layers)) => {
                    layers["hidden"] = vec![24, 24].into();
                }
                ("actor_ema_start", value) => *value = 0.into(),
                ("samples", value) => *value = 3.into(),
                // η moves in each update, and so has to be restored.
                ("eta", Value::Table(eta)) => drop(eta.insert("threshold".to_owned(), 0.5.into())),
                ("behavior_steps" | "critic_steps", value) => *value = 3.into(),
                _ => {}
            }
        }
        variants.push((definition, mem::take(agent)));
    }
    variants
}

fn agent(definition: Definition, table: &toml::Table, context: &Context) -> Agent {
    Agent::new(definition, table, context.clone()).unwrap()
}

/// The items of update number `step`.
fn items(step: u64, agent: &Agent) -> Vec<u32> {
    let first = step as usize * BATCH;
    (first..first + BATCH).map(|item| (item % agent.items()) as u32).collect()
}

fn train(agent: &mut Agent, steps: u64) -> Vec<Vec<f32>> {
    (0..steps).map(|_| agent.update(&items(agent.step(), agent)).unwrap()).collect()
}

#[test]
fn a_saved_state_goes_on_bit_for_bit() {
    for (device, (definition, table)) in
        devices().iter().flat_map(|device| variants().into_iter().map(move |v| (device, v)))
    {
        let context = context(3, device);
        let mut straight = agent(definition, &table, &context);
        train(&mut straight, 7);
        let saved = straight.save().unwrap();
        assert_eq!(saved, straight.save().unwrap(), "saving is repeatable");
        let expected = train(&mut straight, 6);
        let mut resumed = agent(definition, &table, &context);
        resumed.load(&saved).unwrap();
        assert_eq!((resumed.step(), resumed.save().unwrap() == saved), (7, true));
        assert_eq!(train(&mut resumed, 6), expected, "{}", definition.name);
        assert!(resumed.save().unwrap() == straight.save().unwrap(), "{}: another state", definition.name);
    }
}

#[test]
fn a_state_that_does_not_fit_is_refused() {
    let (quad, iql) = (variants()[0].clone(), variants()[6].clone());
    let context = context(3, &Device::Cpu);
    let saved = agent(quad.0, &quad.1, &context).save().unwrap();
    let refused = |definition, table: &toml::Table, bytes: &[u8]| {
        agent(definition, table, &context).load(bytes).unwrap_err().to_string()
    };
    let other = refused(iql.0, &iql.1, &saved);
    assert!(other.contains("quad") && other.contains("iql"), "{other}");
    let mut wider = quad.1.clone();
    wider["actor"].as_table_mut().unwrap().insert("hidden".to_owned(), vec![25].into());
    let shape = refused(quad.0, &wider, &saved);
    assert!(shape.contains("shape"), "{shape}");
    for bytes in [&b""[..], b"nonsense", &saved[..saved.len() - 1]] {
        assert!(!refused(quad.0, &quad.1, bytes).is_empty());
    }
    let policy = agent(quad.0, &quad.1, &context).policy("here").unwrap();
    assert!(refused(quad.0, &quad.1, &policy).contains("`state`"));
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

#[test]
fn every_value_has_a_name_and_every_weight_that_is_trained_a_gradient() {
    for (definition, table) in variants() {
        let mut agent = agent(definition, &table, &context(0, &Device::Cpu));
        // Long enough for each phase of those that have some.
        for values in train(&mut agent, 10) {
            assert_eq!(values.len(), definition.metrics.len(), "{}", definition.name);
            assert!(values.iter().all(|value| value.is_finite()), "{values:?}");
        }
        for (name, moment) in agent.parts().save().unwrap().iter().filter(|(name, _)| name.starts_with("adam_m")) {
            let moment: Vec<f32> = moment.flatten_all().unwrap().to_vec1().unwrap();
            let good =
                moment.iter().all(|x| x.is_finite()) && moment.iter().filter(|x| **x == 0.0).count() * 2 < moment.len();
            assert!(good, "{}: {name} has a gradient that is 0 or not finite", definition.name);
        }
    }
}

/// Weights that are not a number end up in a metric, where the training loop sees it, whatever maximum or minimum they went
/// through; and neither such a state nor such a policy is handed over.
#[test]
fn a_nan_is_never_dropped() {
    for (definition, mut table) in variants() {
        if definition.name == "quad" {
            table.insert("target_reduce".to_owned(), "max".into());
        }
        let count = agent(definition, &table, &context(0, &Device::Cpu)).parts().networks().len();
        assert!(count > 1, "{}", definition.name);
        for network in 0..count {
            let mut agent = agent(definition, &table, &context(0, &Device::Cpu));
            let (name, weights) = agent.parts().networks().swap_remove(network);
            weights.change(|values| values.slice_set(&(values * f64::NAN)?, 0, 0)).unwrap();
            let values = train(&mut agent, 8);
            // AlignIQL acts by its target actor, but learns nothing from it: it is an average of an actor that is watched.
            let unread = (definition.name, name) == ("align-iql", "target_actor");
            assert!(
                unread || values.iter().flatten().any(|value| value.is_nan()),
                "{}: a NaN in {name} is lost",
                definition.name
            );
            assert!(agent.save().is_err(), "{}: a broken state is saved", definition.name);
        }
    }
}

#[test]
fn metric_names_are_prometheus_names_and_distinct() {
    for definition in ALGORITHMS {
        let mut names: Vec<_> = definition.metrics.iter().map(|metric| metric.name).collect();
        assert!(
            names.iter().all(|name| name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')),
            "{names:?}"
        );
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), definition.metrics.len(), "{}", definition.name);
    }
}

/// docs/metrics.md holds a table made of each algorithm's own. `UPDATE_DOCS=1 cargo test -p quad-algorithms documented`
/// writes it anew.
#[test]
fn metrics_are_documented() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/metrics.md");
    let mut text = std::fs::read_to_string(&path).unwrap();
    for Definition { name, metrics, .. } in ALGORITHMS {
        let rows = metrics.iter().map(|Metric { name, help, .. }| {
            format!("| `quad_learner_{name}` | {} | `{name}` |\n", help.replace('|', "\\|"))
        });
        let table = format!("| gauge | what | metrics.jsonl |\n|---|---|---|\n{}", rows.collect::<String>());
        let (begin, end) = (format!("<!-- {name}: made of its table -->\n"), "<!-- end -->\n");
        let from = text.find(&begin).unwrap_or_else(|| panic!("docs/metrics.md lacks {begin}")) + begin.len();
        let to = from + text[from..].find(end).unwrap();
        if std::env::var_os("UPDATE_DOCS").is_some() {
            text.replace_range(from..to, &table);
        }
        let to = from + text[from..].find(end).unwrap();
        assert_eq!(&text[from..to], table, "docs/metrics.md is not what UPDATE_DOCS=1 makes of it");
    }
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(&path, text).unwrap();
    }
}

#[test]
fn golden_folders_are_what_their_script_makes() {
    run(MAKE, &["--check"]);
}
