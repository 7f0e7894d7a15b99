//! Tests of acting by chunks and in other units, against the policy that draws.

use super::*;
use crate::file::{Header, PolicyConfig};
use crate::testing::*;
use quad_nn::Activation;

const A: usize = 2;

/// A policy of chunks of three steps, and what draws them.
fn config(observation_dim: usize) -> PolicyConfig {
    let mut shape = two_units(3 * A);
    shape.observation_dim = observation_dim;
    shape.actor = layers(Activation::Relu, &[8]);
    let choice = Choice::best_of(4);
    PolicyConfig::OneStep { shape, choice }
}

fn drawing(observation_dim: usize) -> Box<dyn Policy> {
    load(&initial(config(observation_dim))).unwrap()
}

fn chunk(history: usize, length: usize, replan: usize) -> Chunk {
    Chunk { history, length, replan }
}

fn affine(offset: &[f32], scale: &[f32]) -> Option<Affine> {
    let (offset, scale) = (offset.to_vec(), scale.to_vec());
    Some(Affine { offset, scale })
}

fn scaling(observations: Option<Affine>, actions: Option<Affine>) -> Scaling {
    let rewards = Some(200.0);
    Scaling { observations, actions, rewards }
}

fn policy(chunk: Chunk) -> Box<dyn Policy> {
    executor(drawing(1), chunk, Scaling::default()).unwrap()
}

/// The actions of one more step in these states.
fn step(policy: &dyn Policy, observations: &[f32], states: &mut [EpisodeState]) -> Vec<f32> {
    let mut actions = vec![0.0; states.len() * policy.action_dim()];
    policy.act(observations, states, &mut actions).unwrap();
    actions
}

#[test]
fn the_first_actions_of_a_chunk_are_executed_before_the_next_is_drawn() {
    let drawing = drawing(1);
    for replan in 1..=3 {
        let (policy, mut state) = (policy(chunk(1, 3, replan)), [drawing.begin(7)]);
        assert_eq!(policy.noise(), [1, 4, 3 * A]);
        let mut expected = [drawing.begin(7)];
        let mut drawn = Vec::new();
        for number in 0..7 {
            let observation = [number as f32 / 5.0];
            if number % replan == 0 {
                drawn = step(&*drawing, &observation, &mut expected);
            }
            let action = step(&*policy, &observation, &mut state);
            assert_eq!(action, drawn[number % replan * A..][..A]);
        }
    }
}

/// In units in which the networks' 0 is 100, and their 1 is 108.
#[test]
fn a_chunk_is_drawn_from_the_last_observations_in_the_networks_units() {
    let drawing = drawing(2);
    let units = scaling(affine(&[100.0], &[8.0]), None);
    let policy = executor(self::drawing(2), chunk(2, 3, 3), units).unwrap();
    assert_eq!(policy.observation_dim(), 1);
    let (mut state, mut expected) = ([drawing.begin(7)], [drawing.begin(7)]);
    for seen in [[0.0, 0.0], [0.25, 0.375]] {
        let drawn = step(&*drawing, &seen, &mut expected);
        for (number, action) in drawn.chunks(A).enumerate() {
            let observation = [100.0 + 8.0 * (seen[1] + number as f32 / 8.0)];
            assert_eq!(step(&*policy, &observation, &mut state), action);
        }
    }
    policy.observe(&[104.0], &mut state);
    let drawn = step(&*drawing, &[0.5, 0.75], &mut expected);
    assert_eq!(step(&*policy, &[106.0], &mut state), drawn[..A]);
}

/// The second episode begins a step later, so that no two draw at the same time.
#[test]
fn an_episode_does_not_depend_on_others() {
    let policy = policy(chunk(1, 3, 2));
    let mut together = [1, 2].map(|seed| policy.begin(seed));
    let mut episodes = [step(&*policy, &[0.1], &mut together[..1]), Vec::new()];
    for _ in 0..4 {
        let both = step(&*policy, &[0.1, 0.2], &mut together);
        episodes[0].extend(&both[..A]);
        episodes[1].extend(&both[A..]);
    }
    for (seed, actions) in [1, 2].into_iter().zip(episodes) {
        let mut state = [policy.begin(seed)];
        for action in actions.chunks(A) {
            let alone = step(&*policy, &[seed as f32 / 10.0], &mut state);
            assert_eq!(alone, action, "episode {seed}");
        }
    }
}

#[test]
fn samples_are_the_first_actions_of_chunks() {
    let policy = policy(chunk(1, 3, 3));
    let Samples { actions, values } = sample(&*policy, &[0.3], &[9]).unwrap();
    let chunks = sample(&*drawing(1), &[0.3], &[9]).unwrap();
    let firsts = chunks.actions.chunks(3 * A).flat_map(|chunk| &chunk[..A]);
    assert!(actions.iter().eq(firsts) && values == chunks.values);
    let taken = act(&*policy, &[0.3], &[9]).unwrap();
    assert!(actions.chunks(A).any(|action| action == taken));
    let single = policy.with_choice(Choice::best_of(1)).unwrap();
    assert_eq!(single.noise(), [1, 1, 3 * A]);
}

#[test]
fn a_single_action_has_no_value() {
    let mut shape = small();
    shape.critics = 0;
    let choice = Choice::best_of(1);
    let without_critics = PolicyConfig::Diffusion { shape, choice };
    for (config, chunk, words) in [
        (config(2), chunk(1, 3, 1), "a history of 1 and a chunk of 3"),
        (config(2), chunk(2, 1, 1), "a history of 2 and a chunk of 1"),
        (without_critics, chunk(1, 2, 1), "no critics"),
    ] {
        let policy = load(&initial(config)).unwrap();
        let policy = executor(policy, chunk, Scaling::default()).unwrap();
        let observation = vec![0.3; policy.observation_dim()];
        let action = vec![0.0; policy.action_dim()];
        let error = policy.value(&observation, &action).unwrap_err();
        assert!(error.to_string().contains(words), "{error}");
    }
}

#[test]
fn a_file_says_the_chunk_and_scales_each_action() {
    let units = scaling(None, affine(&[4.0, -1.0], &[2.0, 0.5]));
    let file = initial(config(1));
    let mut header = Header::<()>::read(&file).unwrap();
    header.chunk = chunk(1, 3, 2);
    header.scaling = Some(units.clone());
    let tensors = crate::file::read_tensors(&file).unwrap();
    let file = header.to_safetensors(&tensors).unwrap();
    assert_eq!(Header::<()>::read(&file).unwrap(), header);
    let policies = [load(&file), executor(drawing(1), header.chunk, units)].map(Result::unwrap);
    let mut states = [(); 2].map(|()| [policies[0].begin(3)]);
    for _ in 0..3 {
        let [read, made] = [0, 1].map(|i| step(&*policies[i], &[0.2], &mut states[i]));
        assert_eq!(read, made);
    }
}

#[test]
fn a_chunk_or_a_scaling_that_does_not_fit_is_refused() {
    let sizes = [(1, 0, 0), (1, 4, 1), (1, 3, 4), (1, 3, 0), (3, 3, 3)];
    for (history, length, replan) in sizes {
        let chunk = chunk(history, length, replan);
        let refused = executor(drawing(1), chunk, Scaling::default());
        assert!(matches!(refused, Err(PolicyError::Range { .. })));
    }
    for units in [
        scaling(affine(&[0.0; 3], &[1.0; 3]), affine(&[0.0; 2], &[1.0; 2])),
        scaling(None, affine(&[0.0; 2], &[1.0, -1.0])),
        scaling(None, affine(&[0.0; 2], &[1.0])),
    ] {
        let refused = load(&diffusion_file(Choice::best_of(6), 1.0, None, Some(units)));
        assert!(matches!(refused, Err(PolicyError::Scaling { .. })));
    }
}

fn assert_close(x: &[f32], y: &[f32]) {
    assert_eq!(x.len(), y.len());
    let is_close = |(x, y): (&f32, &f32)| (x - y).abs() < 1e-5;
    assert!(x.iter().zip(y).all(is_close), "{x:?} {y:?}");
}

/// The third observation and, in the second pass, the second action are constant.
#[test]
fn observations_and_actions_are_converted_and_constants_kept() {
    let ours = [1.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 2.0];
    let users = [108.0, -2.5, 0.1, -4.0, 100.0, -3.0, 90.0, 8.0];
    for (offset, scale) in [([30.0, -1.0], [16.0, 0.25]), ([30.0, 0.1], [16.0, 0.0])] {
        let observations = affine(&[100.0, -3.0, 0.1, 0.0], &[8.0, 0.5, 0.0, 4.0]);
        let units = scaling(observations, affine(&offset, &scale));
        let [plain, scaled] = [None, Some(units)]
            .map(|units| load(&diffusion_file(Choice::best_of(6), 1.0, None, units)).unwrap());
        let to_user = |actions: &[f32]| {
            let mut actions = actions.to_vec();
            affine(&offset, &scale).unwrap().to_user(&mut actions);
            actions
        };
        let taken = act(&*scaled, &users, &[4, 5]).unwrap();
        assert_close(&taken, &to_user(&act(&*plain, &ours, &[4, 5]).unwrap()));
        assert!(scale[1] > 0.0 || taken[1] == 0.1);
        let explored = |policy: &dyn Policy, observations: &[f32]| {
            let mut states = [4, 5].map(|seed| policy.begin(seed));
            let mut actions = [0.0; 4];
            let explored = policy.explore(observations, &mut states, &mut actions);
            explored.map(|()| actions).unwrap()
        };
        let expected = to_user(&explored(&*plain, &ours));
        assert_close(&explored(&*scaled, &users), &expected);
        let expected = sample(&*plain, &ours, &[4, 5]).unwrap();
        let samples = sample(&*scaled, &users, &[4, 5]).unwrap();
        assert_close(&samples.actions, &to_user(&expected.actions));
        assert_eq!(samples.values, expected.values);

        // The networks see 0 for a constant.
        let seen = f32::from(scale[1] > 0.0);
        let actions = [0.5, -0.5 * seen, -0.5, 1.0 * seen];
        let value = scaled.value(&users, &to_user(&actions)).unwrap();
        assert_eq!(value, plain.value(&ours, &actions).unwrap());
        let mut changed = to_user(&[0.5, -0.5]);
        scaled.change_actions(&mut changed, &mut |actions| {
            assert_eq!(actions[0], 0.5);
            actions.fill(-1.0);
        });
        assert_eq!(changed, to_user(&[-1.0; 2]));
        assert!(scaled.memory(3) > plain.memory(3));
        assert_eq!(scaled.choice(), plain.choice());
        assert_eq!(scaled.noise(), [2, 6, 2]);
    }
}
