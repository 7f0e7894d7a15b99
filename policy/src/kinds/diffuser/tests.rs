//! Tests of acting by plans. Golden tests of the algorithm compare the numbers.

use super::*;
use crate::file::PolicyConfig;
use crate::kinds::planner::ValueGuidance;
use crate::sampling::choice::Aggregate;
use crate::testing::{argmax, initial, load, sample, without_tensors};
use quad_nn::{Affine, Scaling, TrajectoryConfig};

const DIMS: (usize, usize) = (4, 2);

fn guidance(scale: f32, stop: usize) -> ValueGuidance {
    ValueGuidance { steps: 2, scale, stop }
}

fn shape(replan_every: usize) -> DiffuserShape {
    let affine = |n| {
        let (offset, scale) = (vec![0.5; n], vec![2.0; n]);
        Some(Affine { offset, scale })
    };
    let (observations, actions) = (affine(DIMS.0), affine(DIMS.1));
    let multipliers = vec![1, 4];
    DiffuserShape {
        observation_dim: DIMS.0,
        action_dim: DIMS.1,
        network: TrajectoryConfig {
            horizon: 4,
            channels: 4,
            multipliers,
            groups: 2,
            attention: None,
        },
        diffusion_steps: 3,
        guidance: guidance(0.5, 1),
        replan_every,
        units: Scaling { observations, actions, rewards: None },
    }
}

fn config(shape: DiffuserShape, plans: u32) -> PolicyConfig {
    let choice = Choice::best_of(plans);
    PolicyConfig::Diffuser { shape, choice }
}

fn policy(shape: DiffuserShape, plans: u32) -> Box<dyn Policy> {
    load(&initial(config(shape, plans))).unwrap()
}

/// The actions at some steps of episodes, whose observations depend on their seeds.
fn acts(policy: &dyn Policy, seeds: &[u64], steps: usize) -> Vec<Vec<f32>> {
    let mut states: Vec<_> = seeds.iter().map(|seed| policy.begin(*seed)).collect();
    let observation = |seed: &u64| [*seed as f32 / 10.0; DIMS.0];
    let observations: Vec<f32> = seeds.iter().flat_map(observation).collect();
    let mut step = || {
        let mut actions = vec![0.0; seeds.len() * DIMS.1];
        policy.act(&observations, &mut states, &mut actions).unwrap();
        actions
    };
    (0..steps).map(|_| step()).collect()
}

#[test]
fn a_plan_is_executed_before_the_next_is_made() {
    let [each, third] = [1, 3].map(|every| acts(&*policy(shape(every), 3), &[7], 4));
    assert_eq!(each[0], third[0], "the first plan is the same");
    assert!(each[1] != third[1] && third[1] != third[2]);
    assert_eq!(each[1], third[3], "the second plan is the same");
}

/// Two chunks of plans, which split a state's.
#[test]
fn an_episode_does_not_depend_on_others() {
    let policy = policy(shape(2), 25);
    let together = acts(&*policy, &[1, 2, 3], 5);
    for (i, seed) in [1, 2, 3].into_iter().enumerate() {
        for (together, alone) in together.iter().zip(acts(&*policy, &[seed], 5)) {
            assert_eq!(together[i * DIMS.1..][..DIMS.1], alone, "episode {seed}");
        }
    }
}

#[test]
fn the_sampled_plan_of_largest_value_is_taken() {
    let policy = policy(shape(2), 6);
    let observations = [0.3; 2 * DIMS.0];
    // One of two states has a plan.
    let begin = || {
        let mut states = [4, 5].map(|seed| policy.begin(seed));
        policy.act(&observations[..DIMS.0], &mut states[..1], &mut [0.0; DIMS.1]).unwrap();
        states
    };
    let samples = policy.sample(&observations, &mut begin()).unwrap();
    let mut actions = [0.0; 2 * DIMS.1];
    policy.act(&observations, &mut begin(), &mut actions).unwrap();
    let (first, second) = samples.actions.split_at(6 * DIMS.1);
    assert!(first.chunks(DIMS.1).all(|action| action == &actions[..DIMS.1]));
    assert!(samples.values[..6].iter().all(|value| *value == samples.values[0]));
    let values = &samples.values[6..];
    assert_eq!(second[argmax(values) * DIMS.1..][..DIMS.1], actions[DIMS.1..]);
    assert!(values.iter().any(|value| *value != values[0]), "values differ");
    assert!(policy.value(&[0.0; 4], &[0.0; 2]).is_err());
}

#[test]
fn guidance_raises_values_but_not_in_the_last_steps() {
    let values = |scale: f32, stop: usize| {
        let mut shape = shape(1);
        shape.guidance = guidance(scale, stop);
        let policy = policy(shape, 20);
        sample(&*policy, &[0.3; DIMS.0], &[0]).unwrap().values
    };
    let sum = |scale| values(scale, 1).iter().sum::<f32>();
    let [low, unguided, high] = [-5.0, 0.0, 5.0].map(sum);
    assert!(low < unguided && unguided < high, "{low} {unguided} {high}");
    assert_eq!(values(5.0, 3), values(0.0, 0), "three of three steps");
    assert_ne!(values(5.0, 2), values(0.0, 0));
}

#[test]
fn a_shape_out_of_range_is_refused() {
    let refused = |change: fn(&mut DiffuserShape)| {
        let mut shape = shape(2);
        change(&mut shape);
        matches!(load(&without_tensors(config(shape, 1))), Err(PolicyError::Range { .. }))
    };
    assert!(refused(|shape| shape.replan_every = 5) && refused(|shape| shape.replan_every = 0));
    assert!(refused(|shape| shape.network.horizon = 3));
    assert!(refused(|shape| shape.diffusion_steps = usize::MAX));
    assert!(refused(|shape| shape.observation_dim = 0) && !refused(|_| ()));
    let nearest = Choice::new(2, Aggregate::Mean, Rule::Nearest);
    let nearest = policy(shape(1), 2).with_choice(nearest);
    assert!(matches!(nearest, Err(PolicyError::NoValue)));
    let guided = Choice { guidance: 1.0, ..Choice::best_of(2) };
    let guided = policy(shape(1), 2).with_choice(guided);
    assert!(matches!(guided, Err(PolicyError::NoGuidance)));
}

#[test]
fn files_call_the_kind_planner() {
    let json = serde_json::to_value(config(shape(1), 1)).unwrap();
    assert_eq!(json["kind"], "planner");
}
