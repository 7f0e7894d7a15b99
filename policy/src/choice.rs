//! How a policy that samples chooses among the actions that it has drawn in a state.

use crate::episode::EpisodeState;
use crate::error::{PolicyError, check_range};
use serde::de::{self, IntoDeserializer};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// How many actions are drawn in each state, and which of them is taken. It travels in a policy's file; an operator may have the
/// policy scored with another.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Choice {
    /// Actions that are drawn, N_a of Eq. 25, within 1..=[`Self::MOST_CANDIDATES`]. Of one nothing is chosen, and the critics
    /// are not asked.
    pub candidates: u32,
    /// How the values that the critics give an action become one.
    pub value: Reduce,
    /// Which action is taken.
    pub rule: Rule,
}

/// How the values that an ensemble of critics gives an action become one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Reduce {
    /// Their mean.
    Mean,
    /// The smallest.
    Min,
}

/// Which of several actions is taken.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Rule {
    /// The one of the largest value, the first of equals.
    Best,
    /// One that is drawn, with a probability proportional to exp(value / temperature).
    Softmax {
        /// Temperature in units of the value, above 0.
        temperature: f32,
    },
    /// The one whose value Q is nearest to the state's own, V: the largest -(Q - V)² (AlignIQL).
    Nearest,
}

impl Choice {
    /// Most actions drawn in a state: far above any use, low enough for evaluators' memory.
    pub const MOST_CANDIDATES: u32 = 10_000;

    /// The best of so many candidates by the mean of the critics (Eq. 25).
    pub fn best_of(candidates: u32) -> Self {
        Self { candidates, value: Reduce::Mean, rule: Rule::Best }
    }

    /// Checks that a policy can act by this choice.
    ///
    /// # Errors
    /// A number of candidates or a temperature out of range.
    pub fn check(&self) -> Result<(), PolicyError> {
        check_range("candidates", self.candidates as usize, Self::MOST_CANDIDATES as usize)?;
        match self.rule {
            Rule::Softmax { temperature } if !(temperature > 0.0 && temperature.is_finite()) => {
                Err(PolicyError::Temperature(temperature))
            }
            _ => Ok(()),
        }
    }

    /// Which of a state's candidates is taken. `worth` has what the rule compares of each: its value, or -(Q - V)².
    pub(crate) fn pick(&self, worth: &[f32], state: &mut EpisodeState) -> Result<usize, PolicyError> {
        if worth.iter().any(|worth| worth.is_nan()) {
            return Err(PolicyError::NotANumber("the value of a candidate"));
        }
        Ok(match self.rule {
            Rule::Softmax { temperature } if worth.len() > 1 => draw(worth, temperature, state.uniform()),
            _ => best(worth),
        })
    }
}

impl Reduce {
    /// The value of each of `rows` actions, of `values`, `critics × rows`. A NaN of one critic is kept.
    pub(crate) fn reduce(self, values: &[f32], rows: usize) -> Vec<f32> {
        let critics = (values.len() / rows) as f32;
        let of_action = |row| {
            let values = values.iter().skip(row).step_by(rows).copied();
            match self {
                Self::Mean => values.map(|q| q / critics).sum(),
                Self::Min => values.fold(f32::INFINITY, |min, q| if q < min || q.is_nan() { q } else { min }),
            }
        };
        (0..rows).map(of_action).collect()
    }
}

/// The place of the largest, the first of equals.
fn best(worth: &[f32]) -> usize {
    (1..worth.len()).fold(0, |best, i| if worth[i] > worth[best] { i } else { best })
}

/// A place, with a probability proportional to exp(worth / temperature); `uniform` is in [0, 1). Relative to the largest worth
/// nothing overflows, and infinite worth counts as equal.
fn draw(worth: &[f32], temperature: f32, uniform: f64) -> usize {
    let largest = worth[best(worth)];
    let weight = |worth: &f32| match *worth == largest {
        true => 1.0,
        false => (f64::from(worth - largest) / f64::from(temperature)).exp(),
    };
    let weights: Vec<f64> = worth.iter().map(weight).collect();
    let mut left = uniform * weights.iter().sum::<f64>();
    let place = weights.iter().position(|weight| {
        left -= weight;
        left < 0.0
    });
    // Rounding may leave no weight for the last: then it is the best.
    place.unwrap_or(best(worth))
}

impl FromStr for Reduce {
    type Err = de::value::Error;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        Self::deserialize(name.into_deserializer())
    }
}

impl FromStr for Rule {
    type Err = &'static str;

    /// `best`, `nearest`, or `softmax:` and a temperature.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let temperature = text.strip_prefix("softmax:").and_then(|number| number.parse().ok());
        match (text, temperature) {
            ("best", _) => Ok(Self::Best),
            ("nearest", _) => Ok(Self::Nearest),
            (_, Some(temperature)) => Ok(Self::Softmax { temperature }),
            _ => Err("one of best, softmax:TEMPERATURE and nearest"),
        }
    }
}

/// As people read it: `10 candidates`, and where it is not the best by the mean, what it is.
impl fmt::Display for Choice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { candidates, value, rule } = self;
        if *candidates == 1 {
            return f.write_str("1 candidate");
        }
        write!(f, "{candidates} candidates")?;
        match rule {
            Rule::Best => {}
            Rule::Softmax { temperature } => write!(f, ", softmax:{temperature}")?,
            Rule::Nearest => f.write_str(", nearest")?,
        }
        if *value == Reduce::Min { f.write_str(", min") } else { Ok(()) }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn a_choice_is_read_as_it_is_written() {
        let softmax = Rule::Softmax { temperature: 0.1 };
        for (rule, json, text) in [
            (Rule::Best, r#""best""#, "best"),
            (softmax, r#"{"softmax":{"temperature":0.1}}"#, "softmax:0.1"),
            (Rule::Nearest, r#""nearest""#, "nearest"),
        ] {
            assert_eq!(serde_json::to_string(&rule).unwrap(), json);
            assert_eq!(serde_json::from_str::<Rule>(json).unwrap(), rule);
            assert_eq!(text.parse::<Rule>().unwrap(), rule);
        }
        assert!("softmax".parse::<Rule>().is_err() && "softmax:warm".parse::<Rule>().is_err());
        let choice = Choice { rule: softmax, value: Reduce::Min, ..Choice::best_of(50) };
        assert_eq!(choice.to_string(), "50 candidates, softmax:0.1, min");
        assert_eq!(Choice { candidates: 1, ..choice }.to_string(), "1 candidate");
    }

    #[test]
    fn critics_are_reduced_and_none_hides_a_nan() {
        let values = [1.0, 5.0, 3.0, 4.0];
        assert_eq!(Reduce::Mean.reduce(&values, 2), [2.0, 4.5]);
        assert_eq!(Reduce::Min.reduce(&values, 2), [1.0, 4.0]);
        for reduce in [Reduce::Mean, Reduce::Min] {
            for values in [[f32::NAN, 0.0], [0.0, f32::NAN]] {
                assert!(reduce.reduce(&values, 1)[0].is_nan());
            }
        }
    }

    #[test]
    fn the_first_of_the_best_is_taken() {
        let pick = |worth: &[f32]| Choice::best_of(3).pick(worth, &mut EpisodeState::new(0));
        assert_eq!(pick(&[1.0, 2.0, 2.0]).unwrap(), 1);
        assert_eq!(pick(&[f32::NEG_INFINITY; 3]).unwrap(), 0);
        assert!(pick(&[0.0, f32::NAN, 1.0]).is_err());
    }

    /// So many draws of each place that its share is within 0.02 of its probability, at any size of the values.
    #[test]
    fn softmax_draws_by_its_probabilities() {
        const DRAWS: usize = 20_000;
        let mut state = EpisodeState::new(3);
        for (scale, temperature) in [(1.0, 2.0), (1e30, 2e30), (1e-30, 2e-30)] {
            let choice = Choice { rule: Rule::Softmax { temperature }, ..Choice::best_of(4) };
            choice.check().unwrap();
            let values = [1.0, -2.0, 3.0, f32::NEG_INFINITY].map(|value: f32| value * scale);
            let mut counts = [0; 4];
            (0..DRAWS).for_each(|_| counts[choice.pick(&values, &mut state).unwrap()] += 1);
            let weights = [1.0, -2.0, 3.0, f64::NEG_INFINITY].map(|value| (value / 2.0).exp());
            for (count, weight) in counts.iter().zip(weights) {
                let (share, expected) = (f64::from(*count) / DRAWS as f64, weight / weights.iter().sum::<f64>());
                assert!((share - expected).abs() < 0.02, "{share} for {expected} at {scale}");
            }
        }
        let cold = Choice { rule: Rule::Softmax { temperature: f32::MIN_POSITIVE }, ..Choice::best_of(3) };
        assert_eq!(cold.pick(&[f32::MAX, f32::MIN, 0.0], &mut state).unwrap(), 0);
        assert_eq!(cold.pick(&[0.0, f32::INFINITY, f32::NEG_INFINITY], &mut state).unwrap(), 1);
    }

    #[test]
    fn a_choice_out_of_range_is_refused() {
        for candidates in [0, 10_001, u32::MAX] {
            assert!(matches!(Choice::best_of(candidates).check(), Err(PolicyError::Range { .. })));
        }
        for temperature in [0.0, -1.0, f32::NAN, f32::INFINITY] {
            let choice = Choice { rule: Rule::Softmax { temperature }, ..Choice::best_of(2) };
            assert!(matches!(choice.check(), Err(PolicyError::Temperature(_))), "{temperature}");
        }
    }
}
