//! Tests of judgments on made-up episodes.

use quad_algorithms::{Fqe, FqeConfig, Units};
use quad_dataset::{Arrays, Split, Transitions};
use quad_policy::{Affine, EpisodeState, Policy, PolicyError, Precision, Scaling};
use quad_run::results::statistics::mean;

use super::actions::{act, scaled};
use super::data::{COMPARED, distance, mean_f32, shared};
use super::evaluation::{LAST, LearningCurve, POINTS};
use super::*;

/// Episodes of `length` steps with a reward for each row, whose states count from 0. Their actions
/// are 0 on average. All but those that are `truncated` terminate.
fn transitions(
    rows: usize,
    length: usize,
    reward: impl Fn(usize) -> f32,
    truncated: &[usize],
) -> Transitions {
    let is_last = |row: usize| row % length == length - 1;
    let is_truncated = |row: usize| is_last(row) && truncated.contains(&(row / length));
    let state = |row: usize| (row % length) as f32;
    Transitions::of(Arrays {
        observation_dim: 1,
        action_dim: 1,
        observations: (0..rows).map(state).collect(),
        actions: (0..rows).map(action).collect(),
        rewards: (0..rows).map(reward).collect(),
        next_observations: (0..rows).map(|row| state(row) + 1.0).collect(),
        terminals: (0..rows).map(|row| is_last(row) && !is_truncated(row)).collect(),
        timeouts: (0..rows).map(is_truncated).collect(),
    })
    .unwrap()
}

fn action(row: usize) -> f32 {
    (row as f32 * 2.4).sin()
}

/// Data that is judged by γ = 0.5, in 200 gradient steps of one seed.
fn data(training: Transitions, held_out: Transitions) -> Data {
    let conditions = Conditions {
        dataset: String::new(),
        environment: String::new(),
        episodes: Vec::new(),
        gamma: 0.5,
        steps: 200,
        seeds: 1,
    };
    let (held_out, episodes, files) = (Some(held_out), vec![1], Vec::new());
    Data::new(Split { training, held_out, episodes, files }, conditions).unwrap()
}

/// A policy whose actions are tenths of its observations.
struct Tenth(usize);

impl Policy for Tenth {
    fn observation_dim(&self) -> usize {
        self.0
    }

    fn action_dim(&self) -> usize {
        self.0
    }

    fn precision(&self) -> Precision {
        Precision::F32
    }

    fn memory(&self, _: usize) -> u64 {
        0
    }

    fn act(
        &self,
        observations: &[f32],
        _: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<(), PolicyError> {
        actions.iter_mut().zip(observations).for_each(|(action, state)| *action = state / 10.0);
        Ok(())
    }
}

#[test]
fn a_policy_acts_in_the_states_that_each_use_needs() {
    let data = data(transitions(4, 4, action, &[]), transitions(6, 3, action, &[]));
    let actions = Actions::new(&Tenth(1), &data).unwrap();
    assert_eq!(actions.next, [0.1, 0.2, 0.3, 0.4]);
    assert_eq!(actions.first, [0.0, 0.0]);
    assert_eq!(actions.compared, [0.0, 0.1, 0.2, 0.0, 0.1, 0.2]);
}

#[test]
fn policies_act_in_the_datas_units() {
    let affine = |offset: [f32; 2], scale: [f32; 2]| {
        Some(Affine { offset: offset.into(), scale: scale.into() })
    };
    let scaling = Scaling {
        observations: affine([100.0, -3.0], [10.0, 2.0]),
        actions: affine([9.0, 0.0], [2.0, 1.0]),
        ..Scaling::default()
    };
    let actions = act(&Tenth(2), &scaling, &[0.0, 0.0, -1.5, 2.0], 0).unwrap();
    assert_eq!(actions, [10.0, -0.3, 8.5, 0.1]);
    assert_eq!(scaled(&scaling, actions), [0.5, -0.3, -0.25, 0.1]);
}

#[test]
fn distances_are_in_standard_deviations() {
    let data = [0.0, 8.0, 2.0, 0.0, 4.0, 4.0];
    let shifted = data.map(|x| x + 3.0);
    let constant = [0.1, 3.0, 0.1, 5.0, 0.1, 7.0];
    let moved = [2.1, 3.0, 2.1, 5.0, 2.1, 7.0];
    // Variances: 8/3 and 32/3; 8/3 beside the constant column.
    for (data, policy, action_dim, expected) in [
        (&data[..], &data[..], 2, 0.0),
        (&data, &[2.0, 4.0, 2.0, 4.0, 2.0, 4.0], 2, 1.0),
        (&data, &shifted, 2, (9.0 * 15.0 / 64.0f64).sqrt()),
        (&constant, &constant, 2, 0.0),
        (&constant, &moved, 2, (4.0 * 3.0 / 16.0f64).sqrt()),
        (&[0.0; 3], &[3.0; 3], 1, 3.0),
    ] {
        let distance = distance(data, policy, action_dim);
        assert!((distance - expected).abs() < 1e-6, "{distance} is not {expected}");
    }
}

#[test]
fn runs_are_judged_in_the_episodes_that_all_have_held_out() {
    assert_eq!(shared([vec![], vec![]].iter()).unwrap(), None);
    let held_out = [vec![7, 3], vec![3, 5, 7], vec![]];
    assert_eq!(shared(held_out.iter()).unwrap(), Some(vec![3, 7]));
    // Older runs drew theirs by the seed.
    let error = shared([vec![1], vec![2]].iter()).unwrap_err();
    assert_eq!(error.to_string(), "no episode is held out by all of these runs");
}

#[test]
fn truncated_episodes_continue_by_the_estimate() {
    let rewards = |row: usize| [2.0, 4.0, 8.0][row % 3];
    let held_out = transitions(6, 3, rewards, &[1]);
    let last = held_out.gather(&[5]);
    let data = data(transitions(3, 3, rewards, &[0]), held_out);
    let units = Units { offset: 100.0, scale: 10.0, least: 0.0, most: 1000.0 };
    let fqes = [0, 1].map(|seed| {
        let config = FqeConfig::with_discount(0.5).unwrap();
        Fqe::new(config, units, data.context(seed)).unwrap()
    });
    let recorded = data.recorded_value(&fqes).unwrap();
    let values = fqes.map(|fqe| mean_f32(&fqe.values(&last.observations, &last.actions).unwrap()));
    let expected = (2.0 + 2.0 + 2.0 + 2.0 + 2.0 + mean(&values) / 4.0) / 2.0;
    assert!((recorded - expected).abs() < 1e-4, "{recorded}, {expected}");
}

#[test]
fn states_to_compare_in_are_from_all_held_out_episodes() {
    let held_out = transitions(2 * COMPARED, 10, action, &[]);
    let compared = data(transitions(10, 10, action, &[]), held_out).compared;
    let expected = Vec::from_iter((0..COMPARED).map(|i| (2 * i % 10) as f32));
    assert_eq!(compared.observations, expected);
}

/// It acts by 0.8 in the first state and by -0.4 in the second, so its value is 0.8 - 0.4 γ.
#[test]
fn a_policy_has_its_own_value_not_the_behaviors() {
    let data = data(transitions(48, 2, action, &[]), transitions(16, 2, action, &[]));
    let evaluation = Evaluation::new(&data).unwrap();
    let value = |curves: &[LearningCurve]| estimate(curves, &evaluation.units).values[0];
    let (behavior, curves) = evaluation.behavior().unwrap();
    assert!(value(&curves).abs() < 0.2, "{} of the behavior", value(&curves));
    let act = |states: &[f32]| Vec::from_iter(states.iter().map(|state| 0.8 - 1.2 * state));
    let training = data.training.gather(&Vec::from_iter(0..48));
    let actions = Actions {
        next: act(&training.next_observations),
        first: act(&data.first.observations),
        compared: Vec::new(),
    };
    let policy = value(&evaluation.policy(&actions, &behavior).unwrap().1);
    assert!((policy - 0.6).abs() < 0.2, "{policy} of the policy");
}

#[test]
fn estimates_that_have_not_converged_are_doubted() {
    let units = Units { offset: 0.0, scale: 10.0, least: 0.0, most: 100.0 };
    for (values, losses, doubt) in [
        ([50.5, 50.0], [1.0, 1.5], ""),
        ([50.0, 52.0], [1.0; 2], "still moves, from 50.00 to 52"),
        ([52.0, 50.0], [1.0; 2], "still moves, from 52.00 to 50"),
        ([50.0; 2], [1.0, 3.0], "grows, from 1.000 to 3.000"),
        ([-3.0; 2], [1.0; 2], "-3.00 is beyond"),
        ([103.0; 2], [1.0; 2], "103.00 is beyond"),
    ] {
        let points =
            |[before, last]: [f64; 2]| [vec![before; POINTS - LAST], vec![last; LAST]].concat();
        let curve = LearningCurve { values: points(values), losses: points(losses) };
        let estimate = estimate(&[curve], &units);
        assert_eq!(estimate.values, [values[1]]);
        assert_eq!(estimate.doubts.is_empty(), doubt.is_empty());
        assert!(estimate.doubts.concat().contains(doubt), "{doubt}");
    }
}
