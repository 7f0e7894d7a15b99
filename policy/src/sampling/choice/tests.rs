//! Tests of `choice.rs`.

use super::*;

#[test]
fn a_choice_is_read_as_it_is_written() {
    let softmax = Rule::Softmax { temperature: 0.1 };
    for (rule, json, text) in [
        (Rule::Best, r#""best""#, "best"),
        (softmax, r#"{"softmax":{"temperature":0.1}}"#, "softmax:0.1"),
        (Rule::Nearest, r#""nearest""#, "nearest"),
        (
            Rule::Average { temperature: 0.01, actions: 4 },
            r#"{"average":{"temperature":0.01,"actions":4}}"#,
            "average:0.01:4",
        ),
    ] {
        assert_eq!(serde_json::to_string(&rule).unwrap(), json);
        assert_eq!(serde_json::from_str::<Rule>(json).unwrap(), rule);
        assert_eq!((text.parse::<Rule>().unwrap(), rule.to_string()), (rule, text.to_owned()));
    }
    assert!("average:0.1".parse::<Rule>().is_err() && "average:0.1:few".parse::<Rule>().is_err());
    assert!("softmax".parse::<Rule>().is_err() && "softmax:warm".parse::<Rule>().is_err());
    let choice = Choice { rule: softmax, value: Aggregate::Min, ..Choice::best_of(50) };
    assert_eq!(choice.to_string(), "50 candidates, softmax:0.1, min");
    assert_eq!(Choice { candidates: 1, ..choice }.to_string(), "1 candidate");
}

#[test]
fn critics_are_reduced_and_none_hides_a_nan() {
    let values = [1.0, 5.0, 3.0, 4.0];
    assert_eq!(Aggregate::Mean.reduce(&values, 2), [2.0, 4.5]);
    assert_eq!(Aggregate::Min.reduce(&values, 2), [1.0, 4.0]);
    for reduce in [Aggregate::Mean, Aggregate::Min] {
        for values in [[f32::NAN, 0.0], [0.0, f32::NAN]] {
            assert!(reduce.reduce(&values, 1)[0].is_nan());
        }
    }
}

#[test]
fn the_first_of_the_best_is_taken() {
    let pick = |worth: &[f32]| Choice::best_of(3).pick(worth, &mut EpisodeState::new(0));
    assert_eq!(pick(&[1.0, 2.0, 2.0]).unwrap(), [1]);
    assert_eq!(pick(&[f32::NEG_INFINITY; 3]).unwrap(), [0]);
    assert!(pick(&[0.0, f32::NAN, 1.0]).is_err());
}

/// So many draws of each place that its share is within 0.02 of its probability, at any size of the
/// values.
#[test]
fn softmax_draws_by_its_probabilities() {
    const DRAWS: usize = 20_000;
    let mut state = EpisodeState::new(3);
    for (scale, temperature) in [(1.0, 2.0), (1e30, 2e30), (1e-30, 2e-30)] {
        let choice = Choice { rule: Rule::Softmax { temperature }, ..Choice::best_of(4) };
        choice.check().unwrap();
        let values = [1.0, -2.0, 3.0, f32::NEG_INFINITY].map(|value: f32| value * scale);
        let mut counts = [0; 4];
        (0..DRAWS).for_each(|_| counts[choice.pick(&values, &mut state).unwrap()[0]] += 1);
        let weights = [1.0, -2.0, 3.0, f64::NEG_INFINITY].map(|value| (value / 2.0).exp());
        for (count, weight) in counts.iter().zip(weights) {
            let (share, expected) =
                (f64::from(*count) / DRAWS as f64, weight / weights.iter().sum::<f64>());
            assert!((share - expected).abs() < 0.02, "{share} for {expected} at {scale}");
        }
    }
    let cold =
        Choice { rule: Rule::Softmax { temperature: f32::MIN_POSITIVE }, ..Choice::best_of(3) };
    assert_eq!(cold.pick(&[f32::MAX, f32::MIN, 0.0], &mut state).unwrap(), [0]);
    assert_eq!(cold.pick(&[0.0, f32::INFINITY, f32::NEG_INFINITY], &mut state).unwrap(), [1]);
}

/// Two of four: each pair as often as the two orders of drawing it say, at values that the bound
/// does not reach.
#[test]
fn several_are_drawn_without_replacement() {
    const DRAWS: usize = 20_000;
    let mut state = EpisodeState::new(4);
    let average = |actions| Choice {
        rule: Rule::Average { temperature: 2.0, actions },
        ..Choice::best_of(4)
    };
    let values = [1.0, -2.0, 3.0, 0.0];
    let mut counts = [[0; 4]; 4];
    for _ in 0..DRAWS {
        let drawn = average(2).pick(&values, &mut state).unwrap();
        assert!(drawn.len() == 2 && drawn[0] != drawn[1]);
        counts[drawn[0]][drawn[1]] += 1;
    }
    let weights = values.map(|value| f64::from(value / 2.0).exp());
    let sum: f64 = weights.iter().sum();
    for (first, second) in (0..4).flat_map(|first| (0..4).map(move |second| (first, second))) {
        let expected = weights[first] / sum * weights[second] / (sum - weights[first]);
        let share = f64::from(counts[first][second]) / DRAWS as f64;
        assert!(
            first == second || (share - expected).abs() < 0.02,
            "{first}, {second}: {share} for {expected}"
        );
    }
    let mut all = average(9).pick(&values, &mut state).unwrap();
    all.sort_unstable();
    assert_eq!(all, [0, 1, 2, 3], "fewer candidates than are to be drawn");
}

/// The second largest value is far below the largest, which counts as no more than forty
/// temperatures above it; so do all that exceed the bound, which are then equals.
#[test]
fn values_far_above_the_others_count_as_equal() {
    const DRAWS: usize = 2_000;
    let mut state = EpisodeState::new(5);
    let choice =
        Choice { rule: Rule::Average { temperature: 1.0, actions: 3 }, ..Choice::best_of(5) };
    let mut first = [0_u32; 5];
    for _ in 0..DRAWS {
        let drawn = choice.pick(&[1e6, 0.0, 1e3, -50.0, -1e9], &mut state).unwrap();
        first[drawn[0]] += 1;
        assert_eq!(drawn.iter().sum::<usize>(), 3, "{drawn:?}: the three largest");
    }
    assert!(first[1] == 0 && first[0].abs_diff(first[2]) < 200, "{first:?}");
}

#[test]
fn a_choice_out_of_range_is_refused() {
    for candidates in [0, 10_001, u32::MAX] {
        assert!(matches!(Choice::best_of(candidates).check(), Err(PolicyError::Range { .. })));
    }
    for temperature in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        let choice = Choice { rule: Rule::Softmax { temperature }, ..Choice::best_of(2) };
        assert!(matches!(choice.check(), Err(PolicyError::Temperature(_))), "{temperature}");
        let choice = Choice { rule: Rule::Average { temperature, actions: 1 }, ..choice };
        assert!(matches!(choice.check(), Err(PolicyError::Temperature(_))), "{temperature}");
    }
    let of_none =
        Choice { rule: Rule::Average { temperature: 1.0, actions: 0 }, ..Choice::best_of(2) };
    assert!(matches!(of_none.check(), Err(PolicyError::Range { .. })));
}

#[test]
fn a_choice_says_how_many_uniform_numbers_it_takes() {
    let uniforms = |candidates, rule| Choice { rule, ..Choice::best_of(candidates) }.uniforms();
    let average = |actions| Rule::Average { temperature: 1.0, actions };
    assert_eq!(
        [uniforms(4, average(3)), uniforms(4, average(9)), uniforms(1, average(3))],
        [3, 4, 0]
    );
    let softmax = Rule::Softmax { temperature: 1.0 };
    assert_eq!([uniforms(4, softmax), uniforms(1, softmax), uniforms(4, Rule::Best)], [1, 0, 0]);
}
