//! Tests of the choice among candidates.

use super::*;

const DRAWS: usize = 20_000;

fn softmax(candidates: u32, temperature: f32) -> Choice {
    Choice::new(candidates, Aggregate::Mean, Rule::softmax(temperature))
}

fn average(candidates: u32, temperature: f32, actions: u32) -> Choice {
    let rule = Rule::Average { temperature, actions };
    Choice::new(candidates, Aggregate::Mean, rule)
}

#[test]
fn a_choice_has_its_text() {
    let softmax_json = r#"{"softmax":{"temperature":0.1}}"#;
    let average_json = r#"{"average":{"temperature":0.01,"actions":4}}"#;
    for (rule, json, text) in [
        (Rule::Best, r#""best""#, "best"),
        (Rule::softmax(0.1), softmax_json, "softmax:0.1"),
        (Rule::Nearest, r#""nearest""#, "nearest"),
        (average(1, 0.01, 4).rule, average_json, "average:0.01:4"),
    ] {
        assert_eq!(serde_json::to_string(&rule).unwrap(), json);
        assert_eq!(serde_json::from_str::<Rule>(json).unwrap(), rule);
        assert_eq!(text.parse(), Ok(rule));
        assert_eq!(rule.to_string(), text);
    }
    for wrong in ["average:0.1", "average:0.1:few", "softmax", "softmax:warm"] {
        assert!(wrong.parse::<Rule>().is_err(), "{wrong}");
    }
    let bound = Aggregate::MeanMinusStd(0.5);
    let (mean, min) = (Aggregate::Mean, Aggregate::Min);
    for (aggregate, text) in [(mean, "mean"), (min, "min"), (bound, "mean-minus-std:0.5")] {
        assert_eq!(text.parse(), Ok(aggregate));
        assert_eq!(aggregate.to_string(), text);
        assert_eq!(serde_json::to_value(aggregate).unwrap(), text);
    }
    for wrong in ["max", "mean:1", "mean-minus-std", "mean-minus-std:-1"] {
        assert!(wrong.parse::<Aggregate>().is_err(), "{wrong}");
    }
    assert!("mean-minus-std:inf".parse::<Aggregate>().is_err());
    let mut choice = Choice::new(50, bound, Rule::softmax(0.1));
    choice.guidance = 0.5;
    let text = "50 candidates, softmax:0.1, mean-minus-std:0.5, guidance 0.5";
    assert_eq!(choice.to_string(), text);
    choice.candidates = 1;
    assert_eq!(choice.to_string(), "1 candidate, guidance 0.5");
    assert_eq!(Choice::best_of(3).to_string(), "3 candidates");
}

#[test]
fn an_aggregate_keeps_nan() {
    let values = [1.0, 5.0, 3.0, 4.0];
    assert_eq!(Aggregate::Mean.reduce(&values, 2), [2.0, 4.5]);
    assert_eq!(Aggregate::Min.reduce(&values, 2), [1.0, 4.0]);
    assert_eq!(Aggregate::MeanMinusStd(2.0).reduce(&values, 2), [0.0, 3.5]);
    let bound = Aggregate::MeanMinusStd(0.0);
    for aggregate in [Aggregate::Mean, Aggregate::Min, bound] {
        assert!(aggregate.reduce(&[f32::NAN, 0.0], 1)[0].is_nan());
        assert!(aggregate.reduce(&[0.0, f32::NAN], 1)[0].is_nan());
    }
}

#[test]
fn the_first_of_the_best_is_taken() {
    let pick = |scores: &[f32]| Choice::best_of(3).pick(scores, &mut EpisodeState::new(0));
    assert_eq!(pick(&[1.0, 2.0, 2.0]).unwrap(), [1]);
    assert_eq!(pick(&[f32::NEG_INFINITY; 3]).unwrap(), [0]);
    assert!(pick(&[0.0, f32::NAN, 1.0]).is_err());
}

#[test]
fn softmax_draws_by_its_probabilities() {
    let mut state = EpisodeState::new(3);
    let values = [1.0, -2.0, 3.0, f32::NEG_INFINITY];
    let weights = values.map(|value| f64::from(value / 2.0).exp());
    for scale in [1.0, 1e30, 1e-30] {
        let (choice, values) = (softmax(4, 2.0 * scale), values.map(|value| value * scale));
        let mut counts = [0; 4];
        (0..DRAWS).for_each(|_| counts[choice.pick(&values, &mut state).unwrap()[0]] += 1);
        for (count, weight) in counts.iter().zip(weights) {
            let expected = weight / weights.iter().sum::<f64>();
            let share = f64::from(*count) / DRAWS as f64;
            assert!((share - expected).abs() < 0.02, "{share} for {expected}");
        }
    }
    let cold = softmax(3, f32::MIN_POSITIVE);
    for (low, high) in [(f32::MIN, f32::MAX), (f32::NEG_INFINITY, f32::INFINITY)] {
        let values = [low, high, 0.0];
        assert_eq!(cold.pick(&values, &mut state).unwrap(), [1]);
    }
}

#[test]
fn several_are_drawn_without_replacement() {
    let mut state = EpisodeState::new(4);
    let values = [1.0, -2.0, 3.0, 0.0];
    let mut counts = [[0; 4]; 4];
    for _ in 0..DRAWS {
        let drawn = average(4, 2.0, 2).pick(&values, &mut state).unwrap();
        assert_eq!(drawn.len(), 2);
        counts[drawn[0]][drawn[1]] += 1;
    }
    let weights = values.map(|value| f64::from(value / 2.0).exp());
    let sum: f64 = weights.iter().sum();
    for (first, second) in (0..16).map(|pair| (pair / 4, pair % 4)) {
        let expected = match first == second {
            true => 0.0,
            false => weights[first] / sum * weights[second] / (sum - weights[first]),
        };
        let share = f64::from(counts[first][second]) / DRAWS as f64;
        assert!((share - expected).abs() < 0.02, "{share} for {expected}");
    }
    let mut drawn = average(4, 2.0, 9).pick(&values, &mut state).unwrap();
    drawn.sort_unstable();
    assert_eq!(drawn, [0, 1, 2, 3], "fewer than are to be drawn");
}

/// All values above the bound of forty temperatures are equal.
#[test]
fn values_far_above_the_others_are_clipped() {
    let mut state = EpisodeState::new(5);
    let mut first = [0_u32; 5];
    for _ in 0..2_000 {
        let values = [1e6, 0.0, 1e3, -50.0, -1e9];
        let drawn = average(5, 1.0, 3).pick(&values, &mut state).unwrap();
        first[drawn[0]] += 1;
        // The three largest.
        assert_eq!(drawn.iter().sum::<usize>(), 3, "{drawn:?}");
    }
    assert_eq!(first[1], 0);
    assert!(first[0].abs_diff(first[2]) < 200, "{first:?}");
}

#[test]
fn a_choice_out_of_range_is_refused() {
    let [none, many] = [0, 10_001].map(Choice::best_of);
    for choice in [none, many, average(2, 1.0, 0)] {
        let checked = choice.check();
        assert!(matches!(checked, Err(PolicyError::Range { .. })));
    }
    for number in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        for choice in [softmax(2, number), average(2, number, 1)] {
            let checked = choice.check();
            assert!(matches!(checked, Err(PolicyError::Temperature(_))));
        }
        let mut guided = Choice::best_of(2);
        guided.guidance = number;
        let is_refused = matches!(guided.check(), Err(PolicyError::Guidance(_)));
        assert_eq!(is_refused, number != 0.0, "{number}");
    }
}

#[test]
fn a_choice_counts_its_uniform_numbers() {
    for (choice, uniforms) in [
        (average(4, 1.0, 3), 3),
        (average(4, 1.0, 9), 4),
        (average(1, 1.0, 3), 0),
        (softmax(4, 1.0), 1),
        (softmax(1, 1.0), 0),
        (Choice::best_of(4), 0),
    ] {
        assert_eq!(choice.uniforms(), uniforms);
    }
}
