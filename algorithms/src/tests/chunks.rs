//! Tests of chunks of actions. The golden folder `fql-chunks` compares the numbers of an update.

use super::*;
use quad_policy::{Precision, load_policy};

/// A network that clones the data in each algorithm that learns chunks.
const CLONING: [(&str, &str); 6] = [
    ("quad", "actor"),
    ("diffusion-policy", "actor"),
    ("dtql", "diffusion"),
    ("fql", "flow"),
    ("idql", "actor"),
    ("qc", "flow"),
];

fn chunked(mut table: toml::Table, chunk: i64) -> toml::Table {
    table.insert("chunk".to_owned(), chunk.into());
    table
}

/// Rows 0 to 9 of each twenty terminate, and 10 to 19 are truncated.
#[test]
fn windows_beyond_the_end_of_an_episode_are_masked() {
    let window = Window { length: 3, gamma: 0.5, ..Window::ONE };
    let transitions = context(0, &Device::Cpu).transitions;
    let examples = Examples::new(transitions, Columns::Plain, window).unwrap();
    let (data, batch) = (arrays(), examples.batch(&[0, 8, 18]).unwrap());
    let (r, a) = (&data.rewards, |row: usize| &data.actions[row * DIMS.1..][..DIMS.1]);
    let numbers = |tensor: &candle_core::Tensor| tensor.to_vec1::<f32>().unwrap();
    let rows = |tensor: &candle_core::Tensor| tensor.to_vec2::<f32>().unwrap();
    let next = candle_core::Tensor::new(&[8f32, 8.0, 8.0], &Device::Cpu).unwrap();
    let targets = numbers(&batch.target(0.5, &next).unwrap());
    let expected =
        [r[0] + 0.5 * r[1] + 0.25 * r[2] + 1.0, r[8] + 0.5 * r[9], r[18] + 0.5 * r[19] + 2.0];
    let apart = targets.iter().zip(expected).map(|(x, y)| (x - y).abs());
    assert!(apart.fold(0.0, f32::max) < 1e-6, "{targets:?} for {expected:?}");
    assert_eq!(rows(&batch.actions)[1], [a(8), a(9), a(9)].concat());
    let beyond = [[1.0; 6].as_slice(), &[0.0; 3]].concat();
    assert_eq!(rows(&batch.within.clone().unwrap()), [vec![1.0; 9], beyond.clone(), beyond]);
    let (zeros, ones) = (batch.actions.zeros_like().unwrap(), batch.actions.ones_like().unwrap());
    let learned = batch.within_episodes(zeros, &ones).unwrap();
    assert_eq!(rows(&learned)[2], [[0.0; 6].as_slice(), &[1.0; 3]].concat());
}

#[test]
fn a_policy_of_chunks_acts_step_by_step() {
    let names = ALGORITHMS.iter().filter(|one| one.chunks).map(|one| one.name);
    assert_eq!(Vec::from_iter(names), CLONING.map(|(name, _)| name));
    for (definition, mut table) in variants().into_iter().filter(|one| one.0.chunks) {
        table.insert("history".to_owned(), 2.into());
        let table = chunked(table, 4);
        let (mut agent, examples) = start(definition, &table, &context(0, &Device::Cpu));
        for values in train(&mut agent, &examples, STEPS) {
            assert!(values.iter().flatten().all(|value| value.is_finite()), "{values:?}");
        }
        let file = agent.policy("here").unwrap();
        let policy = load_policy(&file, Precision::F32).unwrap();
        assert_eq!((policy.observation_dim(), policy.action_dim()), DIMS, "{}", definition.name);
        let mut states = [policy.begin(1)];
        let mut act = |observation: f32| {
            let mut action = [0.0; DIMS.1];
            policy.act(&[observation; DIMS.0], &mut states, &mut action).unwrap();
            action
        };
        let first = act(0.5);
        assert!((1..4).any(|_| act(0.5) != first), "{}", definition.name);
    }
}

/// Episodes of one step, in which the second half of a chunk of two is never seen.
fn single_steps() -> Context {
    let mut arrays = arrays();
    (arrays.terminals, arrays.timeouts) = (vec![true; 10 * BATCH], vec![false; 10 * BATCH]);
    let transitions = Arc::new(Transitions::of(arrays).unwrap());
    Context { transitions, ..context(0, &Device::Cpu) }
}

/// An actor that predicts no noise has no direction in which critics could align.
#[test]
fn actions_beyond_the_end_of_an_episode_do_not_decide_lambda() {
    let is_quad =
        |table: &toml::Table| table.get("guidance").and_then(toml::Value::as_str) == Some("quad");
    let (definition, table) = variants().into_iter().find(|(_, table)| is_quad(table)).unwrap();
    let (mut agent, examples) = start(definition, &chunked(table, 2), &single_steps());
    for (name, weights) in agent.algorithm.state_dict().networks() {
        if name == "actor" {
            weights.change(|values| values.slice_set(&(values * 0.0)?, 0, 0)).unwrap();
        }
    }
    train(&mut agent, &examples, 1);
    let state = agent.algorithm.state_dict().save().unwrap();
    assert_eq!(state["nu_squared"].to_vec1::<f32>().unwrap(), [0.0]);
}

/// But in Diffusion Policy, which executes them.
#[test]
fn actions_beyond_the_end_of_an_episode_are_not_cloned() {
    let context = single_steps();
    for (name, network) in CLONING {
        for (definition, table) in variants().into_iter().filter(|one| one.0.name == name) {
            let (mut agent, examples) = start(definition, &chunked(table, 2), &context);
            train(&mut agent, &examples, 3);
            let state = agent.algorithm.state_dict().save().unwrap();
            // The last layer's bias, one for each number of a chunk.
            let prefix = format!("adam_v.{network}.");
            let is_last = |(moment, x): &(&String, &candle_core::Tensor)| {
                moment.starts_with(&prefix)
                    && moment.ends_with("bias")
                    && x.elem_count() == 2 * DIMS.1
            };
            let last = Vec::from_iter(state.iter().filter(is_last));
            assert_eq!(last.len(), 1, "{name}: {last:?}");
            let moments: Vec<f32> = last[0].1.flatten_all().unwrap().to_vec1().unwrap();
            let (learned, beyond) = moments.split_at(DIMS.1);
            let clones_copies = name == "diffusion-policy";
            assert!(learned.iter().all(|x| *x > 0.0), "{name}");
            assert!(beyond.iter().all(|x| (*x > 0.0) == clones_copies), "{name}");
        }
    }
}
