//! Tests of acting by plans. Golden tests of the algorithm compare the numbers.

use super::*;
use crate::file::PolicyConfig;
use crate::sampling::choice::Aggregate;
use crate::testing::{act, argmax, initial, load, sample, without_tensors};
use quad_nn::{Affine, Scaling, TrajectoryConfig};

const O: usize = 4;
const A: usize = 2;

fn config(plans: u32, change: impl FnOnce(&mut DiffuserShape)) -> PolicyConfig {
    let affine = |n| {
        let (offset, scale) = (vec![0.5; n], vec![2.0; n]);
        Some(Affine { offset, scale })
    };
    let mut shape = DiffuserShape {
        observation_dim: O,
        action_dim: A,
        network: TrajectoryConfig {
            horizon: 4,
            channels: 4,
            multipliers: vec![1, 4],
            groups: 2,
            attention: None,
        },
        diffusion_steps: 3,
        guidance: guidance(0.5, 1),
        replan_every: 2,
        units: Scaling { observations: affine(O), actions: affine(A), rewards: None },
    };
    change(&mut shape);
    let choice = Choice::best_of(plans);
    PolicyConfig::Diffuser { shape, choice }
}

fn guidance(scale: f32, stop: usize) -> ValueGuidance {
    let steps = 2;
    ValueGuidance { steps, scale, stop }
}

fn policy(plans: u32, change: impl FnOnce(&mut DiffuserShape)) -> Box<dyn Policy> {
    load(&initial(config(plans, change))).unwrap()
}

/// The actions at some steps of episodes, whose observations depend on their seeds.
fn acts(policy: &dyn Policy, seeds: &[u64], steps: usize) -> Vec<Vec<f32>> {
    let mut states = Vec::from_iter(seeds.iter().map(|seed| policy.begin(*seed)));
    let observations = Vec::from_iter(seeds.iter().flat_map(|seed| [*seed as f32 / 10.0; O]));
    let mut step = || {
        let mut actions = vec![0.0; seeds.len() * A];
        let acted = policy.act(&observations, &mut states, &mut actions);
        acted.map(|()| actions).unwrap()
    };
    (0..steps).map(|_| step()).collect()
}

#[test]
fn a_plan_is_executed_before_the_next_is_made() {
    let [each, third] =
        [1, 3].map(|every| acts(&*policy(3, |shape| shape.replan_every = every), &[7], 4));
    assert_eq!(each[0], third[0], "the first plan is the same");
    assert!(each[1] != third[1] && third[1] != third[2]);
    assert_eq!(each[1], third[3], "the second plan is the same");
}

/// Two chunks of plans, which split a state's.
#[test]
fn an_episode_does_not_depend_on_others() {
    let policy = policy(25, |_| ());
    let together = acts(&*policy, &[1, 2, 3], 5);
    for (i, seed) in [1, 2, 3].into_iter().enumerate() {
        for (together, alone) in together.iter().zip(acts(&*policy, &[seed], 5)) {
            assert_eq!(together[i * A..][..A], alone, "episode {seed}");
        }
    }
}

#[test]
fn the_sampled_plan_of_largest_value_is_taken() {
    let policy = policy(6, |_| ());
    let Samples { actions, values } = sample(&*policy, &[0.3; O], &[5]).unwrap();
    let taken = act(&*policy, &[0.3; O], &[5]).unwrap();
    assert_eq!(actions[argmax(&values) * A..][..A], taken);
    assert!(values.iter().any(|value| *value != values[0]));
    assert!(policy.value(&[0.0; O], &[0.0; A]).is_err());
}

#[test]
fn guidance_raises_values_but_not_in_the_last_steps() {
    let values = |scale: f32, stop: usize| {
        let policy = policy(20, |shape| shape.guidance = guidance(scale, stop));
        sample(&*policy, &[0.3; O], &[0]).unwrap().values
    };
    let [low, unguided, high] = [-5.0, 0.0, 5.0].map(|scale| values(scale, 1).iter().sum::<f32>());
    assert!(low < unguided && unguided < high, "{low} {unguided} {high}");
    assert_eq!(values(5.0, 3), values(0.0, 0), "three of three steps");
    assert_ne!(values(5.0, 2), values(0.0, 0));
}

#[test]
fn a_shape_or_a_choice_out_of_range_is_refused() {
    let changes: [fn(&mut DiffuserShape); 5] = [
        |shape| shape.replan_every = 5,
        |shape| shape.replan_every = 0,
        |shape| shape.network.horizon = 3,
        |shape| shape.diffusion_steps = usize::MAX,
        |shape| shape.observation_dim = 0,
    ];
    for change in changes {
        let refused = load(&without_tensors(config(1, change)));
        assert!(matches!(refused, Err(PolicyError::Range { .. })));
    }
    let policy = policy(2, |_| ());
    let nearest = Choice::new(2, Aggregate::Mean, Rule::Nearest);
    let nearest = policy.with_choice(nearest);
    assert!(matches!(nearest, Err(PolicyError::NoValue)));
    let mut guided = Choice::best_of(2);
    guided.guidance = 1.0;
    let guided = policy.with_choice(guided);
    assert!(matches!(guided, Err(PolicyError::NoGuidance)));
    let json = serde_json::to_value(config(1, |_| ())).unwrap();
    assert_eq!(json["kind"], "planner", "the name in files");
}
