//! Tests of chunks of actions. The golden folder `fql-chunks` compares the numbers of an update, its
//! targets and masks included.

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

/// The variants of an algorithm with chunks of this many actions.
fn chunked(name: &str, chunk: i64) -> Vec<Variant> {
    let mut variants = variants();
    variants.retain(|variant| variant.name == name);
    for variant in &mut variants {
        variant.table.insert("chunk".to_owned(), chunk.into());
    }
    variants
}

#[test]
fn a_policy_of_chunks_acts_step_by_step() {
    let chunks = ALGORITHMS.iter().filter(|definition| definition.chunks);
    let names = Vec::from_iter(chunks.map(|definition| definition.name));
    assert_eq!(names, CLONING.map(|(name, _)| name));
    for mut variant in names.into_iter().flat_map(|name| chunked(name, 4)) {
        variant.table.insert("history".to_owned(), 2.into());
        let mut trial = variant.start(&context(0, &Device::Cpu));
        let values = trial.train(STEPS).concat();
        let mut measured = values.iter().flatten();
        assert!(measured.all(|value| value.is_finite()), "{values:?}");
        let policy = load_policy(&trial.policy(), Precision::F32).unwrap();
        let dims = (policy.observation_dim(), policy.action_dim());
        assert_eq!(dims, DIMS, "{}", variant.name);
        let mut states = [policy.begin(1)];
        let mut act = |observation: f32| {
            let mut action = [0.0; DIMS.1];
            policy.act(&[observation; DIMS.0], &mut states, &mut action).unwrap();
            action
        };
        let first = act(0.5);
        assert!((1..4).any(|_| act(0.5) != first), "{}", variant.name);
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
    let is_quad = |variant: &Variant| variant.table["guidance"].as_str() == Some("quad");
    let variant = chunked("quad", 2).into_iter().find(is_quad).unwrap();
    let mut trial = variant.start(&single_steps());
    trial.scale(|_, network| if network == "actor" { 0.0 } else { 1.0 });
    trial.train(1);
    assert_eq!(trial.state("nu_squared")[""], [0.0]);
}

/// But in Diffusion Policy, which executes them.
#[test]
fn actions_beyond_the_end_of_an_episode_are_not_cloned() {
    let context = single_steps();
    for (name, network) in CLONING {
        for variant in chunked(name, 2) {
            let mut trial = variant.start(&context);
            trial.train(3);
            // The last layer's bias, one for each number of a chunk.
            let moments = trial.state(&format!("adam_v.{network}."));
            let is_last = |(tensor, x): &(&String, &Vec<f32>)| {
                tensor.ends_with("bias") && x.len() == 2 * DIMS.1
            };
            let last = Vec::from_iter(moments.iter().filter(is_last));
            assert_eq!(last.len(), 1, "{name}: {last:?}");
            let (learned, beyond) = last[0].1.split_at(DIMS.1);
            let clones_copies = name == "diffusion-policy";
            assert!(learned.iter().all(|x| *x > 0.0), "{name}");
            assert!(beyond.iter().all(|x| (*x > 0.0) == clones_copies), "{name}");
        }
    }
}
