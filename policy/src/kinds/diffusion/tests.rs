//! Tests of the diffusion policy and of what all policies with candidates share.

use super::*;
use crate::error::PolicyError;
use crate::file::PolicyConfig;
use crate::policy::{Policy, Samples};
use crate::sampling::choice::{Aggregate, Rule};
use crate::testing::*;

fn policy(choice: Choice, critic: f32, v: Option<f32>) -> Result<Box<dyn Policy>> {
    load(&diffusion_file(choice, critic, v, None))
}

fn config(choice: Choice, change: impl FnOnce(&mut DiffusionShape)) -> PolicyConfig {
    let mut shape = small();
    change(&mut shape);
    PolicyConfig::Diffusion { shape, choice }
}

/// Observations of three states.
fn observations() -> Vec<f32> {
    (0..12).map(|i| (i as f32).sin()).collect()
}

/// Finite weights so large that values overflow.
#[test]
fn a_nan_is_an_error() {
    let [good, broken] =
        [0.1, 1e38].map(|critic| policy(Choice::best_of(5), critic, None).unwrap());
    // Of both signs, so that infinities meet.
    let observation = [1.0, -1.0, 1.0, 1.0];
    let single = broken.with_choice(Choice::best_of(1)).unwrap();
    assert!(act(&*good, &observation, &[3]).is_ok());
    // One candidate needs no critics.
    assert!(act(&*single, &observation, &[3]).is_ok());
    let value_error = "the value of a candidate is not a number (NaN)";
    for (error, words) in [
        (act(&*broken, &observation, &[3]).err(), value_error),
        (sample(&*single, &observation, &[3]).err(), value_error),
        (single.value(&observation, &[0.5; 2]).err(), "not a number"),
        (act(&*good, &[f32::NAN; 4], &[3]).err(), "not a number"),
    ] {
        let error = error.unwrap().to_string();
        assert!(error.contains(words), "{error}");
    }
}

/// None may ask for unbounded memory, nor by numbers that wrap around.
#[test]
fn a_shape_out_of_range_is_refused() {
    let refused = |change: &dyn Fn(&mut DiffusionShape)| {
        let file = without_tensors(config(Choice::best_of(1), change));
        matches!(load(&file), Err(PolicyError::Range { .. }))
    };
    for steps in [0, 1001, (1 << 58) + 1, usize::MAX] {
        assert!(refused(&|shape| shape.diffusion_steps = steps), "{steps}");
    }
    assert!(refused(&|shape| shape.critics = MAX_DIM + 1));
    assert!(!refused(&|_| ()), "a good shape without tensors");
}

#[test]
fn a_policy_without_critics_takes_what_it_draws() {
    let load_with = |critics, candidates| {
        let choice = Choice::best_of(candidates);
        load(&initial(config(choice, |shape| shape.critics = critics)))
    };
    let [without, with] = [0, 2].map(|critics| load_with(critics, 1).unwrap());
    let action = |policy: &dyn Policy| act(policy, &[0.5; 4], &[3]).unwrap();
    assert_eq!(action(&*without), action(&*with));
    assert_eq!((without.choice(), without.noise()), (None, vec![2, 1, 2]));
    assert!(without.memory(5) < with.memory(5));
    let lacks_critics = |error| matches!(error, Some(PolicyError::NoCritics));
    assert!(lacks_critics(load_with(0, 2).err()));
    for (candidates, aggregate, rule) in [
        (2, Aggregate::Mean, Rule::Best),
        (1, Aggregate::Min, Rule::Best),
        (1, Aggregate::Mean, Rule::softmax(1.0)),
    ] {
        let choice = Choice::new(candidates, aggregate, rule);
        assert!(lacks_critics(without.with_choice(choice).err()), "{choice}");
    }
    assert!(lacks_critics(without.value(&[0.5; 4], &[0.0; 2]).err()));
}

#[test]
fn the_rule_of_the_file_applies_unless_another_is_requested() {
    let [best, nearest, cold] = [Rule::Best, Rule::Nearest, Rule::softmax(1e-6)]
        .map(|rule| Choice::new(8, Aggregate::Min, rule));
    let action = |policy: &dyn Policy| act(policy, &[0.5; 4], &[3]).unwrap();
    // The nearest to a V above all Q is the best, to one below all Q the worst.
    let [high, low] = [1e3, -1e3].map(|v| action(&*policy(nearest, 1.0, Some(v)).unwrap()));
    assert_ne!(high, low);
    let written = policy(best, 1.0, None).unwrap();
    let other = written.with_choice(cold).unwrap();
    for (policy, choice) in [(&written, best), (&other, cold)] {
        assert_eq!(policy.choice(), Some(choice));
        assert_eq!(action(&**policy), high);
    }
    let lacks_value = |policy| matches!(policy, Err(PolicyError::NoValue));
    assert!(lacks_value(written.with_choice(nearest)) && lacks_value(policy(nearest, 0.1, None)));
    let many = written.with_choice(Choice::best_of(10_001));
    assert!(matches!(many, Err(PolicyError::Range { .. })));
}

#[test]
fn the_sampled_candidate_of_largest_value_is_taken() {
    let bound = Aggregate::MeanMinusStd(1.0);
    for aggregate in [Aggregate::Mean, Aggregate::Min, bound] {
        let policy = policy(Choice::new(6, aggregate, Rule::Best), 1.0, None).unwrap();
        let (observations, seeds) = (observations(), [7, 8, 9]);
        let Samples { actions, values } = sample(&*policy, &observations, &seeds).unwrap();
        assert_eq!((actions.len(), values.len()), (3 * 6 * 2, 3 * 6));
        let taken = act(&*policy, &observations, &seeds).unwrap();
        for (i, taken) in taken.chunks_exact(2).enumerate() {
            let (actions, values) = (&actions[i * 12..][..12], &values[i * 6..][..6]);
            assert_eq!(taken, &actions[argmax(values) * 2..][..2], "state {i}");
            assert!(values.iter().any(|value| value != &values[0]));
            let observations = observations[i * 4..][..4].repeat(6);
            assert_eq!(policy.value(&observations, actions).unwrap(), values);
        }
        // A state by itself.
        let alone = sample(&*policy, &observations[4..8], &[8]).unwrap();
        assert_eq!(alone.actions, actions[12..24]);
        assert_eq!(alone.values, values[6..12]);
        // 3 observations, 18 actions.
        assert!(policy.value(&observations, &actions).is_err());
    }
}

#[test]
fn guidance_raises_the_values_of_what_is_drawn() {
    let unguided = policy(Choice::best_of(6), 0.5, None).unwrap();
    let guided = |guidance| {
        let mut choice = Choice::best_of(6);
        choice.guidance = guidance;
        unguided.with_choice(choice).unwrap()
    };
    let seeds = [7, 8, 9];
    let drawn = |guidance| sample(&*guided(guidance), &observations(), &seeds).unwrap();
    let [none, weak, strong] = [0.0, 0.1, 10.0].map(drawn);
    assert_eq!(none, sample(&*unguided, &observations(), &seeds).unwrap());
    let sum = |samples: &Samples| samples.values.iter().sum::<f32>();
    assert!(sum(&none) < sum(&weak) && sum(&weak) < sum(&strong));
    // A state by itself.
    let alone = sample(&*guided(10.0), &observations()[4..8], &[8]).unwrap();
    assert_eq!(alone.actions, strong.actions[12..24]);
}

/// The name in files before it was `aggregate`.
#[test]
fn a_choice_may_call_the_aggregate_value() {
    let json = r#"{"candidates":5,"value":"min","rule":"best"}"#;
    let expected = Choice::new(5, Aggregate::Min, Rule::Best);
    assert_eq!(serde_json::from_str::<Choice>(json).unwrap(), expected);
}
