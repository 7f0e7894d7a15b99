//! How a policy that samples chooses among the actions that it has drawn in a state.

use crate::error::{PolicyError, check_range};
use crate::sampling::episode::EpisodeState;
use serde::de::{self, IntoDeserializer};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// How many actions are drawn in each state, and which of them is taken, or the mean of which. It
/// travels in a policy's file; an operator may have the policy scored with another.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Choice {
    /// Actions that are drawn, N_a of Eq. 25, within 1..=[`Self::MOST_CANDIDATES`]. Of one nothing
    /// is chosen, and the critics are not asked.
    pub candidates: u32,
    /// How the values that the critics give an action become one.
    pub value: Aggregate,
    /// Which action is taken.
    pub rule: Rule,
}

/// How the values that an ensemble of critics gives an action become one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Aggregate {
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
    /// The mean of several that are drawn, each once, with probabilities as of [`Self::Softmax`]
    /// (SfBC). Values count up to forty temperatures above the smallest of as many largest, so that
    /// no draw is a certainty too early.
    Average {
        /// Temperature in units of the value, above 0.
        temperature: f32,
        /// How many are drawn, at least 1; all of fewer candidates.
        actions: u32,
    },
}

/// Temperatures by which values may exceed the smallest of the largest.
const MOST_ABOVE: f32 = 40.0;

impl Choice {
    /// Most actions drawn in a state: far above any use, low enough for evaluators' memory.
    pub const MOST_CANDIDATES: u32 = 10_000;

    /// The best of so many candidates by the mean of the critics (Eq. 25).
    pub fn best_of(candidates: u32) -> Self {
        Self { candidates, value: Aggregate::Mean, rule: Rule::Best }
    }

    /// Checks that a policy can act by this choice.
    ///
    /// # Errors
    /// A number of candidates or a temperature out of range.
    pub fn check(&self) -> Result<(), PolicyError> {
        check_range("candidates", self.candidates as usize, Self::MOST_CANDIDATES as usize)?;
        if let Rule::Average { actions, .. } = self.rule {
            check_range("actions", actions as usize, Self::MOST_CANDIDATES as usize)?;
        }
        match self.rule {
            Rule::Softmax { temperature } | Rule::Average { temperature, .. }
                if !(temperature > 0.0 && temperature.is_finite()) =>
            {
                Err(PolicyError::Temperature(temperature))
            }
            _ => Ok(()),
        }
    }

    /// How many uniform numbers [`Rule`] takes to choose in a state.
    pub fn uniforms(&self) -> usize {
        match self.rule {
            Rule::Softmax { .. } if self.candidates > 1 => 1,
            Rule::Average { actions, .. } if self.candidates > 1 => {
                actions.min(self.candidates) as usize
            }
            _ => 0,
        }
    }

    /// Which of a state's candidates are taken: one, or several of which the mean is the action.
    /// `worth` has what the rule compares of each: its value, or -(Q - V)².
    pub(crate) fn pick(
        &self,
        worth: &[f32],
        state: &mut EpisodeState,
    ) -> Result<Vec<usize>, PolicyError> {
        if worth.iter().any(|worth| worth.is_nan()) {
            return Err(PolicyError::NotANumber("the value of a candidate"));
        }
        Ok(match self.rule {
            Rule::Softmax { temperature } if worth.len() > 1 => {
                vec![draw(worth, temperature, state.uniform())]
            }
            Rule::Average { temperature, actions } if worth.len() > 1 => {
                draw_several(worth, temperature, actions as usize, state)
            }
            _ => vec![best(worth)],
        })
    }
}

impl Aggregate {
    /// The value of each of `rows` actions, of `values`, `critics × rows`. A NaN of one critic is
    /// kept.
    pub(crate) fn reduce(self, values: &[f32], rows: usize) -> Vec<f32> {
        let critics = (values.len() / rows) as f32;
        let of_action = |row| {
            let values = values.iter().skip(row).step_by(rows).copied();
            match self {
                Self::Mean => values.map(|q| q / critics).sum(),
                Self::Min => {
                    values.fold(f32::INFINITY, |min, q| if q < min || q.is_nan() { q } else { min })
                }
            }
        };
        (0..rows).map(of_action).collect()
    }
}

/// The place of the largest, the first of equals.
fn best(worth: &[f32]) -> usize {
    (1..worth.len()).fold(0, |best, i| if worth[i] > worth[best] { i } else { best })
}

/// A place, with a probability proportional to exp(worth / temperature); `uniform` is in [0, 1).
/// Relative to the largest worth nothing overflows, and infinite worth counts as equal.
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

/// So many places, or all of fewer, each once, with a probability among those left as [`draw`] has
/// it.
fn draw_several(
    worth: &[f32],
    temperature: f32,
    count: usize,
    state: &mut EpisodeState,
) -> Vec<usize> {
    let count = count.min(worth.len());
    let mut sorted = worth.to_vec();
    sorted.sort_unstable_by(|x, y| y.total_cmp(x));
    let most = sorted[count - 1] + MOST_ABOVE * temperature;
    let mut left: Vec<f32> = worth.iter().map(|worth| worth.min(most)).collect();
    let mut places: Vec<usize> = (0..worth.len()).collect();
    let mut one = || {
        let drawn = draw(&left, temperature, state.uniform());
        left.remove(drawn);
        places.remove(drawn)
    };
    (0..count).map(|_| one()).collect()
}

impl FromStr for Aggregate {
    type Err = de::value::Error;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        Self::deserialize(name.into_deserializer())
    }
}

impl FromStr for Rule {
    type Err = &'static str;

    /// As [`Display`](fmt::Display) writes it.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let expected = "one of best, softmax:TEMPERATURE, average:TEMPERATURE:ACTIONS and nearest";
        let temperature = |text: &str| text.parse().map_err(|_| expected);
        match text.split(':').collect::<Vec<_>>()[..] {
            ["best"] => Ok(Self::Best),
            ["nearest"] => Ok(Self::Nearest),
            ["softmax", number] => Ok(Self::Softmax { temperature: temperature(number)? }),
            ["average", number, actions] => {
                let actions = actions.parse().map_err(|_| expected)?;
                Ok(Self::Average { temperature: temperature(number)?, actions })
            }
            _ => Err(expected),
        }
    }
}

/// As an operator writes it: `best`, `softmax:0.1`, `average:0.01:4`, `nearest`.
impl fmt::Display for Rule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Best => f.write_str("best"),
            Self::Softmax { temperature } => write!(f, "softmax:{temperature}"),
            Self::Nearest => f.write_str("nearest"),
            Self::Average { temperature, actions } => write!(f, "average:{temperature}:{actions}"),
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
        if *rule != Rule::Best {
            write!(f, ", {rule}")?;
        }
        if *value == Aggregate::Min { f.write_str(", min") } else { Ok(()) }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests;
