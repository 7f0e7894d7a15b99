//! Tests of the diffusion policy and of what all policies with candidates share.

use super::*;
use crate::error::PolicyError;
use crate::file::PolicyConfig;
use crate::policy::{Policy, Samples};
use crate::sampling::choice::{Aggregate, Rule};
use crate::testing::{act, argmax, diffusion_file, initial, load, sample, small, without_tensors};

fn policy(choice: Choice, critic: f32, v: Option<f32>) -> Result<Box<dyn Policy>> {
    load(&diffusion_file(choice, critic, v, None))
}

/// Finite weights so large that values overflow.
#[test]
fn a_nan_is_an_error() {
    let five = Choice::best_of(5);
    let [good, broken] = [0.1, 1e38].map(|critic| policy(five, critic, None).unwrap());
    // Of both signs, so that infinities meet.
    let observation = [1.0, -1.0, 1.0, 1.0];
    let of_one = broken.with_choice(Choice::best_of(1)).unwrap();
    // One candidate needs no critics.
    assert!([&good, &of_one].iter().all(|policy| act(&***policy, &observation, &[3]).is_ok()));
    let errors = [
        act(&*broken, &observation, &[3]).unwrap_err(),
        sample(&*of_one, &observation, &[3]).unwrap_err(),
        of_one.value(&observation, &[0.5, -0.5]).unwrap_err(),
        act(&*good, &[f32::NAN, 0.0, 0.0, 0.0], &[3]).unwrap_err(),
    ];
    let of_value = "the value of a candidate is not a number (NaN)";
    let what = errors.map(|error| error.to_string());
    assert!(what[..2].iter().all(|what| what == of_value), "{what:?}");
    assert!(what.iter().all(|what| what.contains("not a number")), "{what:?}");
}

/// None may ask for unbounded memory, nor by numbers that wrap around.
#[test]
fn a_shape_out_of_range_is_refused() {
    let refused = |shape: DiffusionShape| {
        let choice = Choice::best_of(1);
        let file = without_tensors(PolicyConfig::Diffusion { shape, choice });
        matches!(load(&file), Err(PolicyError::Range { .. }))
    };
    for diffusion_steps in [0, 1001, (1 << 58) + 1, usize::MAX] {
        assert!(refused(DiffusionShape { diffusion_steps, ..small() }), "{diffusion_steps}");
    }
    assert!(refused(DiffusionShape { critics: MAX_DIM + 1, ..small() }));
    assert!(!refused(small()), "a good shape without tensors");
}

#[test]
fn a_policy_without_critics_takes_what_it_draws() {
    let file = |critics, candidates| {
        let (shape, choice) = (DiffusionShape { critics, ..small() }, Choice::best_of(candidates));
        load(&initial(PolicyConfig::Diffusion { shape, choice }))
    };
    let [without, with] = [0, 2].map(|critics| file(critics, 1).unwrap());
    let action = |policy: &dyn Policy| act(policy, &[0.5; 4], &[3]).unwrap();
    assert_eq!(action(&*without), action(&*with));
    assert_eq!((without.choice(), without.noise()), (None, vec![2, 1, 2]));
    assert!(without.memory(5) < with.memory(5));
    let lacks_critics = |error| matches!(error, Some(PolicyError::NoCritics));
    assert!(lacks_critics(file(0, 2).err()));
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
    let of_best = policy(best, 1.0, None).unwrap();
    assert_eq!((of_best.choice(), action(&*of_best)), (Some(best), high.clone()));
    assert_ne!(high, low);
    let other = of_best.with_choice(cold).unwrap();
    assert_eq!((other.choice(), action(&*other)), (Some(cold), high.clone()));
    assert!(matches!(of_best.with_choice(nearest), Err(PolicyError::NoValue)));
    assert!(matches!(policy(nearest, 0.1, None), Err(PolicyError::NoValue)));
    let many = of_best.with_choice(Choice::best_of(10_001));
    assert!(matches!(many, Err(PolicyError::Range { .. })));
    assert_eq!((of_best.choice(), action(&*of_best)), (Some(best), high), "unchanged");
}

#[test]
fn the_sampled_candidate_of_largest_value_is_taken() {
    for aggregate in [Aggregate::Mean, Aggregate::Min, Aggregate::MeanMinusStd(1.0)] {
        let policy = policy(Choice::new(6, aggregate, Rule::Best), 1.0, None).unwrap();
        let observations: Vec<f32> = (0..12).map(|i| (i as f32).sin()).collect();
        let seeds = [7, 8, 9];
        let Samples { actions, values } = sample(&*policy, &observations, &seeds).unwrap();
        assert_eq!((actions.len(), values.len()), (3 * 6 * 2, 3 * 6));
        let taken = act(&*policy, &observations, &seeds).unwrap();
        for (i, taken) in taken.chunks_exact(2).enumerate() {
            let (actions, values) = (&actions[i * 12..][..12], &values[i * 6..][..6]);
            assert_eq!(taken, &actions[argmax(values) * 2..][..2], "state {i}");
            assert!(values.iter().any(|value| value != &values[0]), "values differ");
            let observations = observations[i * 4..][..4].repeat(6);
            assert_eq!(policy.value(&observations, actions).unwrap(), values, "state {i}");
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
    let of_file = policy(Choice::best_of(6), 0.5, None).unwrap();
    let observations: Vec<f32> = (0..12).map(|i| (i as f32).sin()).collect();
    let drawn = |guidance| {
        let choice = Choice { guidance, ..Choice::best_of(6) };
        sample(&*of_file.with_choice(choice).unwrap(), &observations, &[7, 8, 9]).unwrap()
    };
    let [none, weak, strong] = [0.0, 0.1, 10.0].map(drawn);
    assert_eq!(none, sample(&*of_file, &observations, &[7, 8, 9]).unwrap(), "off");
    for (less, more) in [(&none, &weak), (&weak, &strong)] {
        let mean = |samples: &Samples| samples.values.iter().sum::<f32>() / 18.0;
        assert!(mean(less) < mean(more), "{less:?} {more:?}");
    }
    // A state by itself.
    let choice = Choice { guidance: 10.0, ..Choice::best_of(6) };
    let alone = sample(&*of_file.with_choice(choice).unwrap(), &observations[4..8], &[8]).unwrap();
    assert_eq!(alone.actions, strong.actions[12..24]);
}

/// The name in files before it was `aggregate`.
#[test]
fn a_choice_may_call_the_aggregate_value() {
    let json = r#"{"candidates":5,"value":"min","rule":"best"}"#;
    let expected = Choice::new(5, Aggregate::Min, Rule::Best);
    assert_eq!(serde_json::from_str::<Choice>(json).unwrap(), expected);
}
