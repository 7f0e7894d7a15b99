//! Tests of acting by plans; their numbers are compared with a script's in the crate of the
//! algorithms.

use super::*;
use crate::file::{Header, PolicyConfig, load_policy};
use crate::kinds::planner::ValueGuidance;
use candle_core::Device;
use quad_kernels::scaling::{Affine, Scaling};
use quad_nn::TrajectoryConfig;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const DIMS: (usize, usize) = (4, 2);

fn shape(replan_every: usize) -> DiffuserShape {
    let affine = |n| Some(Affine { offset: vec![0.5; n], scale: vec![2.0; n] });
    DiffuserShape {
        observation_dim: DIMS.0,
        action_dim: DIMS.1,
        network: TrajectoryConfig {
            horizon: 4,
            channels: 4,
            multipliers: vec![1, 4],
            groups: 2,
            attention: None,
        },
        diffusion_steps: 3,
        guidance: ValueGuidance { steps: 2, scale: 0.5, stop: 1 },
        replan_every,
        units: Scaling { observations: affine(DIMS.0), actions: affine(DIMS.1), rewards: None },
    }
}

fn file(shape: DiffuserShape, plans: u32) -> Vec<u8> {
    let generator = &mut ChaCha8Rng::seed_from_u64(5);
    let policy = PolicyConfig::Diffuser { shape, choice: Choice::best_of(plans) };
    let tensors =
        policy.tensors(|layout| Weights::initial(layout, generator, &Device::Cpu)).unwrap();
    Header::new(policy, ()).to_safetensors(&tensors).unwrap()
}

fn policy(replan_every: usize, plans: u32) -> Box<dyn Policy> {
    load_policy(&file(shape(replan_every), plans), Precision::F32).unwrap()
}

/// What it does in so many steps of an episode with this observation.
fn acts(policy: &dyn Policy, seeds: &[u64], steps: usize) -> Vec<Vec<f32>> {
    let mut states: Vec<_> = seeds.iter().map(|seed| policy.begin(*seed)).collect();
    let observations: Vec<f32> =
        seeds.iter().flat_map(|seed| [*seed as f32 / 10.0; DIMS.0]).collect();
    let mut step = || {
        let mut actions = vec![0.0; seeds.len() * DIMS.1];
        policy.act(&observations, &mut states, &mut actions).unwrap();
        actions
    };
    (0..steps).map(|_| step()).collect()
}

#[test]
fn a_plan_is_followed_and_then_made_again() {
    let [each, third] = [acts(&*policy(1, 3), &[7], 4), acts(&*policy(3, 3), &[7], 4)];
    assert_eq!(each[0], third[0], "the plan is the same");
    assert!(each[1] != third[1] && third[1] != third[2]);
    // The second plan of each draws the same noise in the same state.
    assert_eq!(each[1], third[3]);
}

#[test]
fn an_episode_does_not_depend_on_those_beside_it() {
    // More windows than a chunk, cut within a state's.
    let policy = policy(2, 25);
    let together = acts(&*policy, &[1, 2, 3], 5);
    for (i, seed) in [1, 2, 3].into_iter().enumerate() {
        for (together, alone) in together.iter().zip(acts(&*policy, &[seed], 5)) {
            assert_eq!(together[i * DIMS.1..][..DIMS.1], alone, "episode {seed}");
        }
    }
}

#[test]
fn what_is_sampled_is_what_is_chosen_among() {
    let policy = policy(2, 6);
    let begin = || [4, 5].map(|seed| policy.begin(seed));
    let (mut acting, mut sampling) = (begin(), begin());
    let observations = [0.3; 2 * DIMS.0];
    // One of the two is in the middle of its plan.
    for states in [&mut acting, &mut sampling] {
        policy.act(&observations[..DIMS.0], &mut states[..1], &mut [0.0; DIMS.1]).unwrap();
    }
    let sampled = policy.sample(&observations, &mut sampling).unwrap();
    let mut actions = [0.0; 2 * DIMS.1];
    policy.act(&observations, &mut acting, &mut actions).unwrap();
    let (of_first, of_second) = sampled.actions.split_at(6 * DIMS.1);
    assert!(of_first.chunks(DIMS.1).all(|action| action == &actions[..DIMS.1]));
    assert!(sampled.values[..6].iter().all(|value| *value == sampled.values[0]));
    let values = &sampled.values[6..];
    let best = (1..6).fold(0, |best, i| if values[i] > values[best] { i } else { best });
    assert_eq!(of_second[best * DIMS.1..][..DIMS.1], actions[DIMS.1..]);
    assert!(
        values.iter().any(|value| *value != values[0])
            && policy.value(&[0.0; 4], &[0.0; 2]).is_err()
    );
}

#[test]
fn guidance_raises_values() {
    let mean = |scale: f32| {
        let mut shape = shape(1);
        shape.guidance.scale = scale;
        let policy = load_policy(&file(shape, 20), Precision::F32).unwrap();
        policy.sample(&[0.3; DIMS.0], &mut [policy.begin(0)]).unwrap().values.iter().sum::<f32>()
            / 20.0
    };
    assert!(
        mean(5.0) > mean(0.0) && mean(0.0) > mean(-5.0),
        "{} {} {}",
        mean(5.0),
        mean(0.0),
        mean(-5.0)
    );
}

#[test]
fn the_last_denoising_steps_so_many_are_not_guided() {
    let values = |scale: f32, stop: usize| {
        let guidance = ValueGuidance { steps: 2, scale, stop };
        let policy =
            load_policy(&file(DiffuserShape { guidance, ..shape(1) }, 4), Precision::F32).unwrap();
        policy.sample(&[0.3; DIMS.0], &mut [policy.begin(0)]).unwrap().values
    };
    let unguided = values(0.0, 0);
    assert_eq!(values(5.0, 3), unguided, "of three steps");
    assert_ne!(values(5.0, 2), unguided);
}

#[test]
fn a_shape_out_of_range_is_refused() {
    let refused = |change: fn(&mut DiffuserShape)| {
        let mut shape = shape(2);
        change(&mut shape);
        let policy = PolicyConfig::Diffuser { shape, choice: Choice::best_of(1) };
        let file = Header::new(policy, ()).to_safetensors(&Tensors::new()).unwrap();
        matches!(load_policy(&file, Precision::F32), Err(PolicyError::Range { .. }))
    };
    assert!(refused(|shape| shape.replan_every = 5) && refused(|shape| shape.replan_every = 0));
    assert!(
        refused(|shape| shape.network.horizon = 3)
            && refused(|shape| shape.diffusion_steps = usize::MAX)
    );
    assert!(refused(|shape| shape.observation_dim = 0) && !refused(|_| ()));
    let header = Header::<()>::read(&file(shape(1), 1)).unwrap();
    assert_eq!(serde_json::to_value(header.policy).unwrap()["kind"], "planner");
    let nearest = Choice { rule: Rule::Nearest, ..Choice::best_of(2) };
    assert!(matches!(policy(1, 2).with_choice(nearest), Err(PolicyError::NoValue)));
}
