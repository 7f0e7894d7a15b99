//! Tests of what every algorithm must do, and of the tables that derive from it.

use super::golden::{devices, make};
use super::*;
use crate::config::resolve;
use crate::train::agent::Agent;
use candle_core::Device;
use quad_dataset::Batch;
use quad_policy::Precision;
use quad_protocol::Origin;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const DIMS: (usize, usize) = (11, 3);
const STEPS: u64 = 50;

/// A setting for small random batches.
fn setting(seed: u64, device: &Device) -> Setting {
    Setting {
        observation_dim: DIMS.0,
        action_dim: DIMS.1,
        // More than a tile of rows, and no multiple of it.
        batch_size: 150,
        total_steps: STEPS,
        seed,
        precision: Precision::F32,
        device: device.clone(),
    }
}

/// The demonstration by all algorithms and variants, with small networks.
fn variants() -> Vec<(Definition, toml::Table)> {
    let mut variants = Vec::new();
    for (algorithm, guidance) in [("quad", Some("quad")), ("quad", Some("dac")), ("quad", Some("none")), ("iql", None)]
    {
        let asked = toml::Table::from_iter([("algorithm".to_owned(), algorithm.into())]);
        let mut experiment = resolve("hopper-demo", &asked).unwrap();
        experiment.agent.insert("hidden".to_owned(), 24.into());
        if let Some(guidance) = guidance {
            experiment.agent.insert("guidance".to_owned(), guidance.into());
            experiment.agent.insert("actor_ema_start".to_owned(), 0.into());
            experiment.agent.insert("samples".to_owned(), 3.into());
        }
        // η moves in each update, and so has to be restored.
        if guidance == Some("quad") {
            experiment.agent["eta"].as_table_mut().unwrap().insert("threshold".to_owned(), 0.5.into());
        }
        variants.push((experiment.definition().unwrap(), experiment.agent));
    }
    variants
}

fn agent(definition: Definition, table: &toml::Table, setting: &Setting) -> Agent {
    let algorithm = (definition.read)(table).unwrap().start(setting).unwrap();
    Agent::new(definition, algorithm, setting.device.clone())
}

fn origin() -> Origin {
    Origin { environment: "hopper".to_owned(), seed: 0, step: 0, episodes: 10 }
}

/// Batch number `step`.
fn batch(step: u64, size: usize) -> Batch {
    let mut generator = ChaCha8Rng::seed_from_u64(step);
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

fn train(agent: &mut Agent, steps: u64, batch_size: usize) -> Vec<Vec<f32>> {
    (0..steps).map(|_| agent.update(&batch(agent.step(), batch_size)).unwrap()).collect()
}

#[test]
fn a_saved_state_goes_on_bit_for_bit() {
    for (device, (definition, table)) in
        devices().iter().flat_map(|device| variants().into_iter().map(move |v| (device, v)))
    {
        let setting = setting(3, device);
        let mut straight = agent(definition, &table, &setting);
        train(&mut straight, 7, setting.batch_size);
        let saved = straight.save().unwrap();
        assert_eq!(saved, straight.save().unwrap(), "saving is repeatable");
        let expected = train(&mut straight, 6, setting.batch_size);
        let mut resumed = agent(definition, &table, &setting);
        resumed.load(&saved).unwrap();
        assert_eq!((resumed.step(), resumed.save().unwrap() == saved), (7, true));
        assert_eq!(train(&mut resumed, 6, setting.batch_size), expected, "{}", definition.name);
        assert!(resumed.save().unwrap() == straight.save().unwrap(), "{}: another state", definition.name);
    }
}

#[test]
fn a_state_that_does_not_fit_is_refused() {
    let (quad, iql) = (variants()[0].clone(), variants()[3].clone());
    let setting = setting(3, &Device::Cpu);
    let saved = agent(quad.0, &quad.1, &setting).save().unwrap();
    let refused = |definition, table: &toml::Table, bytes: &[u8]| {
        agent(definition, table, &setting).load(bytes).unwrap_err().to_string()
    };
    let other = refused(iql.0, &iql.1, &saved);
    assert!(other.contains("quad") && other.contains("iql"), "{other}");
    let mut wider = quad.1.clone();
    wider.insert("hidden".to_owned(), 25.into());
    let shape = refused(quad.0, &wider, &saved);
    assert!(shape.contains("shape"), "{shape}");
    for bytes in [&b""[..], b"nonsense", &saved[..saved.len() - 1]] {
        assert!(!refused(quad.0, &quad.1, bytes).is_empty());
    }
    let policy = agent(quad.0, &quad.1, &setting).policy(&origin()).unwrap();
    assert!(refused(quad.0, &quad.1, &policy).contains("counters"));
}

#[test]
fn the_seed_alone_decides_the_weights() {
    for (definition, table) in variants() {
        let run = |seed| {
            let setting = setting(seed, &Device::Cpu);
            let mut agent = agent(definition, &table, &setting);
            let first = agent.policy(&origin()).unwrap();
            train(&mut agent, 3, setting.batch_size);
            (first, agent.policy(&origin()).unwrap())
        };
        let (first, last) = run(1);
        assert!((first.clone(), last.clone()) == run(1) && first != last);
        let (other_first, other_last) = run(2);
        assert!(first != other_first && last != other_last);
    }
}

#[test]
fn every_weight_gets_a_finite_gradient_that_is_not_zero() {
    for (definition, table) in variants() {
        let setting = setting(0, &Device::Cpu);
        let mut algorithm = (definition.read)(&table).unwrap().start(&setting).unwrap();
        let batch = Minibatch::new(&batch(0, setting.batch_size), &setting.device).unwrap();
        algorithm.update(0, &batch).unwrap();
        for (name, moment) in algorithm.state().unwrap().iter().filter(|(name, _)| name.starts_with("adam_m")) {
            let moment: Vec<f32> = moment.flatten_all().unwrap().to_vec1().unwrap();
            let good = moment.iter().all(|x| x.is_finite() && *x != 0.0);
            assert!(good, "{}: {name} has a gradient that is 0 or not finite", definition.name);
        }
    }
}

#[test]
fn every_value_has_a_name() {
    for (definition, table) in variants() {
        let setting = setting(0, &Device::Cpu);
        let mut agent = agent(definition, &table, &setting);
        for values in train(&mut agent, 2, setting.batch_size) {
            assert_eq!(values.len(), definition.metrics.len(), "{}", definition.name);
            assert!(values.iter().all(|value| value.is_finite()), "{values:?}");
        }
    }
}

/// What is not a number ends up in a metric, where the training loop sees it, whatever maximum or minimum it went through.
#[test]
fn a_nan_is_never_dropped() {
    for (definition, mut table) in variants() {
        if definition.name == "quad" {
            table.insert("target_reduce".to_owned(), "max".into());
        }
        let setting = setting(0, &Device::Cpu);
        for name in ["observations", "next observations", "actions"] {
            let mut agent = agent(definition, &table, &setting);
            let mut batch = batch(0, setting.batch_size);
            match name {
                "observations" => batch.observations[5] = f32::NAN,
                "actions" => batch.actions[5] = f32::NAN,
                _ => batch.next_observations[5] = f32::NAN,
            }
            let values = agent.update(&batch).unwrap();
            assert!(values.iter().any(|value| value.is_nan()), "{}: a NaN in the {name} is lost", definition.name);
            if name != "actions" {
                assert!(agent.save().is_err(), "{}: a broken state is saved", definition.name);
            }
        }
    }
}

#[test]
fn a_policy_with_a_nan_is_not_handed_over() {
    for (definition, table) in variants() {
        let setting = setting(0, &Device::Cpu);
        let mut agent = agent(definition, &table, &setting);
        let mut batch = batch(0, setting.batch_size);
        batch.observations[0] = f32::NAN;
        agent.update(&batch).unwrap();
        train(&mut agent, 4, setting.batch_size);
        let error = agent.policy(&origin()).unwrap_err().to_string();
        assert!(error.contains("tensor") && error.contains("not finite"), "{error}");
    }
}

#[test]
fn a_batch_of_other_dimensions_is_refused() {
    for (definition, table) in variants() {
        let setting = setting(0, &Device::Cpu);
        let mut narrow = batch(0, setting.batch_size);
        narrow.observations.truncate(setting.batch_size * (DIMS.0 - 1));
        assert!(agent(definition, &table, &setting).update(&narrow).is_err(), "{}", definition.name);
    }
}

#[test]
fn metric_names_are_prometheus_names_and_distinct() {
    for definition in ALGORITHMS {
        let mut names: Vec<_> = definition.metrics.iter().map(|metric| metric.name).collect();
        assert!(names.iter().all(|name| name.chars().all(|c| c.is_ascii_lowercase() || c == '_')), "{names:?}");
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), definition.metrics.len(), "{}", definition.name);
    }
}

/// docs/metrics.md holds a table made of each algorithm's own. `UPDATE_DOCS=1 cargo test -p quad-learner documented`
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
    make(&["--check"]);
}
