//! Tests of acting by chunks, against the policy that draws them.

use super::*;
use crate::file::{Header, PolicyConfig};
use crate::kinds::actor_critic::ActorCriticShape;
use crate::kinds::diffusion::DiffusionShape;
use crate::scaled::scaled;
use crate::testing::{act, initial, layers, load, sample, small};
use quad_kernels::scaling::{Affine, Scaling};
use quad_nn::{Activation, Layout, Weights};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const A: usize = 2;

/// A policy of chunks of three steps, and what draws them.
fn config(observation_dim: usize, candidates: u32) -> PolicyConfig {
    let (actor, critic) = (layers(Activation::Relu, &[8]), layers(Activation::Relu, &[8]));
    let shape = ActorCriticShape { observation_dim, action_dim: 3 * A, actor, critic, critics: 2 };
    PolicyConfig::OneStep { shape, choice: Choice::best_of(candidates) }
}

fn drawing(candidates: u32) -> Box<dyn Policy> {
    load(&initial(config(1, candidates))).unwrap()
}

fn policy(candidates: u32, replan: usize) -> Box<dyn Policy> {
    chunked(drawing(candidates), Chunk { length: 3, replan, ..Chunk::default() }).unwrap()
}

/// The actions of one more step in these states.
fn step(policy: &dyn Policy, observations: &[f32], states: &mut [EpisodeState]) -> Vec<f32> {
    let mut actions = vec![0.0; states.len() * policy.action_dim()];
    policy.act(observations, states, &mut actions).unwrap();
    actions
}

#[test]
fn the_first_actions_of_a_chunk_are_executed_before_the_next_is_drawn() {
    let drawing = drawing(4);
    for replan in 1..=3 {
        let (policy, mut state) = (policy(4, replan), [drawing.begin(7)]);
        assert_eq!((policy.action_dim(), policy.noise()), (A, vec![1, 4, 3 * A]));
        let mut expected = [drawing.begin(7)];
        let mut chunk = Vec::new();
        for number in 0..7 {
            let observation = [number as f32 / 5.0];
            if number % replan == 0 {
                chunk = step(&*drawing, &observation, &mut expected);
            }
            let action = step(&*policy, &observation, &mut state);
            assert_eq!(action, chunk[number % replan * A..][..A], "step {number} of {replan}");
        }
    }
}

#[test]
fn a_chunk_is_drawn_from_the_last_observations() {
    let drawing = load(&initial(config(2, 4))).unwrap();
    let chunk = Chunk { history: 2, length: 3, replan: 3 };
    let policy = chunked(load(&initial(config(2, 4))).unwrap(), chunk).unwrap();
    assert_eq!(policy.observation_dim(), 1);
    let (mut state, mut expected) = ([drawing.begin(7)], [drawing.begin(7)]);
    for seen in [[0.0, 0.0], [0.2, 0.3]] {
        let drawn = step(&*drawing, &seen, &mut expected);
        let first = seen[1];
        for (number, action) in drawn.chunks(A).enumerate() {
            let observation = [first + number as f32 / 10.0];
            assert_eq!(step(&*policy, &observation, &mut state), action, "{seen:?}, {number}");
        }
    }
    policy.observe(&[0.5], &mut state);
    let drawn = step(&*drawing, &[0.5, 0.6], &mut expected);
    assert_eq!(step(&*policy, &[0.6], &mut state), drawn[..A]);
    assert!(matches!(
        chunked(drawing, Chunk { history: 3, ..chunk }),
        Err(PolicyError::Range { field: "chunk.history", .. })
    ));
}

#[test]
fn observations_are_remembered_in_the_networks_units() {
    let chunk = Chunk { history: 2, length: 3, replan: 1 };
    let [plain, users] = [0, 1].map(|_| chunked(load(&initial(config(2, 4))).unwrap(), chunk));
    let observations = Some(Affine { offset: vec![100.0], scale: vec![8.0] });
    let users = scaled(users.unwrap(), Scaling { observations, ..Scaling::default() }).unwrap();
    let (plain, mut state, mut expected) = (plain.unwrap(), [users.begin(7)], [users.begin(7)]);
    users.observe(&[104.0], &mut state);
    plain.observe(&[0.5], &mut expected);
    let actions = step(&*users, &[106.0], &mut state);
    assert_eq!(actions, step(&*plain, &[0.75], &mut expected));
}

/// The second episode begins a step later, so that no two draw at the same time.
#[test]
fn an_episode_does_not_depend_on_others() {
    let policy = policy(3, 2);
    let mut together = [1, 2].map(|seed| policy.begin(seed));
    let first = step(&*policy, &[0.1], &mut together[..1]);
    let mut actions = [first, Vec::new()];
    for _ in 0..4 {
        let both = step(&*policy, &[0.1, 0.2], &mut together);
        actions.iter_mut().zip(both.chunks(A)).for_each(|(all, action)| all.extend(action));
    }
    for (seed, actions) in [1, 2].into_iter().zip(actions) {
        let mut alone = [policy.begin(seed)];
        for action in actions.chunks(A) {
            assert_eq!(step(&*policy, &[seed as f32 / 10.0], &mut alone), action);
        }
    }
}

#[test]
fn samples_are_the_first_actions_of_chunks() {
    let (policy, drawing) = (policy(5, 3), drawing(5));
    let Samples { actions, values } = sample(&*policy, &[0.3], &[9]).unwrap();
    let of_chunks = sample(&*drawing, &[0.3], &[9]).unwrap();
    let firsts = of_chunks.actions.chunks(3 * A).flat_map(|chunk| &chunk[..A]);
    assert!(actions.iter().eq(firsts) && values == of_chunks.values);
    assert!(actions.chunks(A).any(|action| action == act(&*policy, &[0.3], &[9]).unwrap()));
    let of_one = policy.with_choice(Choice::best_of(1)).unwrap();
    assert_eq!(of_one.noise(), [1, 1, 3 * A]);
}

#[test]
fn a_single_action_has_no_value() {
    let error = |policy: PolicyConfig, history, length| {
        let chunk = Chunk { history, length, replan: 1 };
        let policy = chunked(load(&initial(policy)).unwrap(), chunk).unwrap();
        let (observation, action) = (policy.observation_dim(), policy.action_dim());
        policy.value(&vec![0.3; observation], &vec![0.0; action]).unwrap_err().to_string()
    };
    for (history, length) in [(1, 3), (2, 1)] {
        let error = error(config(2, 4), history, length);
        let words = format!("a history of {history} and a chunk of {length}");
        assert!(error.contains(&words), "{error}");
    }
    let (shape, choice) = (DiffusionShape { critics: 0, ..small() }, Choice::best_of(1));
    let error = error(PolicyConfig::Diffusion { shape, choice }, 1, 2);
    assert!(error.contains("no critics"), "{error}");
}

#[test]
fn a_file_says_the_chunk_and_scales_each_action() {
    let generator = &mut ChaCha8Rng::seed_from_u64(5);
    let policy = config(1, 2);
    let weights = |layout: &Layout| Weights::initial(layout, generator, &candle_core::Device::Cpu);
    let tensors = policy.tensors(weights).unwrap();
    let actions = Affine { offset: vec![4.0, -1.0], scale: vec![2.0, 0.5] };
    let scaling = Scaling { actions: Some(actions), ..Scaling::default() };
    let file = |chunk| {
        let header = Header::new(policy.clone(), ());
        let header = Header { chunk, scaling: Some(scaling.clone()), ..header };
        header.to_safetensors(&tensors).unwrap()
    };
    let chunk = Chunk { length: 3, replan: 2, ..Chunk::default() };
    let found = load(&file(chunk)).unwrap();
    let expected = scaled(self::policy(2, 2), scaling.clone()).unwrap();
    let mut states = [[found.begin(3)], [found.begin(3)]];
    for _ in 0..3 {
        let [one, other] = &mut states;
        assert_eq!(step(&*found, &[0.2], one), step(&*expected, &[0.2], other));
    }
    assert_eq!(Header::<()>::read(&file(chunk)).unwrap().chunk, chunk);

    let refused = |length, replan| {
        let chunked = chunked(drawing(1), Chunk { length, replan, ..Chunk::default() });
        matches!(chunked, Err(PolicyError::Range { .. }))
    };
    assert!(refused(0, 0) && refused(4, 1) && refused(12, 1) && refused(3, 4) && refused(3, 0));
    assert!(!refused(6, 6) && !refused(2, 1));
}
