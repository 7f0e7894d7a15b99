//! The choice among the candidates of a state.

use crate::error::{PolicyError, Result, check_range};
use crate::sampling::episode::EpisodeState;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// The number of candidates, the choice among them, and guidance as they are drawn. A policy's file
/// has one; users can ask for another.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Choice {
    /// Candidates N_a of Eq. 25, within 1..=[`Self::MOST_CANDIDATES`]. A single one is taken without
    /// evaluating the critics.
    pub candidates: u32,
    /// Aggregate of the critics' values. Older files call it `value`.
    #[serde(alias = "value")]
    pub aggregate: Aggregate,
    /// Rule of the choice.
    pub rule: Rule,
    /// Strength of the critics' guidance as a diffusion policy draws candidates, 1/β of QGF, per unit
    /// of value; 0 for none ([`NoisePredictor::sample_guided`](quad_nn::NoisePredictor::sample_guided)).
    #[serde(default, skip_serializing_if = "is_zero")]
    pub guidance: f32,
}

fn is_zero(strength: &f32) -> bool {
    *strength == 0.0
}

/// Aggregate of the values of an ensemble of critics.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
#[allow(missing_docs)]
pub enum Aggregate {
    Mean,
    Min,
    /// Mean − κ·√variance, a lower confidence bound. The variance is divided by the number of critics.
    MeanMinusStd(f32),
}

/// Rule of the choice among candidates.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Rule {
    /// The candidate of the largest value, the first of equals.
    Best,
    /// A candidate drawn with a probability proportional to exp(value / temperature).
    Softmax {
        /// Temperature in units of the value, above 0.
        temperature: f32,
    },
    /// The candidate whose value Q is nearest to V(s): the largest −(Q − V)² (AlignIQL).
    Nearest,
    /// The mean of several candidates drawn as in [`Self::Softmax`], without replacement (SfBC).
    /// Values are clipped at forty temperatures above the smallest of the `actions` largest ones,
    /// which keeps the first draws random.
    Average {
        /// Temperature in units of the value, above 0.
        temperature: f32,
        /// Number of candidates drawn, at least 1; all, if there are fewer.
        actions: u32,
    },
}

/// Clipping of values in [`Rule::Average`], in temperatures.
const MOST_ABOVE: f32 = 40.0;

impl Choice {
    /// Largest number of candidates, which bounds an evaluator's memory.
    pub const MOST_CANDIDATES: u32 = 10_000;

    /// The best of this many candidates by the mean of the critics (Eq. 25).
    pub const fn best_of(candidates: u32) -> Self {
        Self::new(candidates, Aggregate::Mean, Rule::Best)
    }

    /// A choice of these values, which [`Self::check`] checks.
    pub const fn new(candidates: u32, aggregate: Aggregate, rule: Rule) -> Self {
        Self { candidates, aggregate, rule, guidance: 0.0 }
    }

    /// Checks the numbers of candidates, the temperature and the strength of guidance.
    pub fn check(&self) -> Result<()> {
        let most = Self::MOST_CANDIDATES as usize;
        check_range("candidates", self.candidates as usize, most)?;
        if let Rule::Average { actions, .. } = self.rule {
            check_range("actions", actions as usize, most)?;
        }
        if !(self.guidance >= 0.0 && self.guidance.is_finite()) {
            return Err(PolicyError::Guidance(self.guidance));
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

    /// Number of uniform numbers that the choice in a state draws.
    pub fn uniforms(&self) -> usize {
        match self.rule {
            Rule::Softmax { .. } if self.candidates > 1 => 1,
            Rule::Average { actions, .. } if self.candidates > 1 => {
                actions.min(self.candidates) as usize
            }
            _ => 0,
        }
    }

    /// Indices of the chosen candidates, of which the mean is the action. `scores` are values, or
    /// −(Q − V)² for [`Rule::Nearest`].
    pub(crate) fn pick(&self, scores: &[f32], state: &mut EpisodeState) -> Result<Vec<usize>> {
        if scores.iter().any(|score| score.is_nan()) {
            return Err(PolicyError::NotANumber("the value of a candidate"));
        }
        Ok(match self.rule {
            Rule::Softmax { temperature } if scores.len() > 1 => {
                vec![draw(scores, temperature, state.uniform())]
            }
            Rule::Average { temperature, actions } if scores.len() > 1 => {
                draw_several(scores, temperature, actions as usize, state)
            }
            _ => vec![best(scores)],
        })
    }

    /// Writes the mean of each state's chosen candidates to `actions`, states × a. `drawn` is
    /// states × candidates × a, and `scores` are those that [`Self::pick`] takes.
    pub(crate) fn take(
        &self,
        drawn: &[f32],
        scores: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<()> {
        let (candidates, a) = (self.candidates as usize, actions.len() / states.len());
        let scores = scores.chunks_exact(candidates);
        let candidates = drawn.chunks_exact(candidates * a).zip(scores);
        let states = states.iter_mut().zip(candidates);
        for (action, (state, (drawn, scores))) in actions.chunks_exact_mut(a).zip(states) {
            let chosen = self.pick(scores, state)?;
            for (j, x) in action.iter_mut().enumerate() {
                let sum = chosen.iter().map(|place| drawn[place * a + j]).sum::<f32>();
                *x = sum / chosen.len() as f32;
            }
        }
        Ok(())
    }
}

impl Rule {
    /// [`Self::Softmax`] with this temperature.
    pub const fn softmax(temperature: f32) -> Self {
        Self::Softmax { temperature }
    }
}

impl Aggregate {
    /// The aggregate of each of `rows` actions, for `values` `critics × rows`. Keeps NaN.
    pub fn reduce(self, values: &[f32], rows: usize) -> Vec<f32> {
        let critics = (values.len() / rows) as f32;
        let min = |min, q: f32| match q < min || q.is_nan() {
            true => q,
            false => min,
        };
        let aggregate = |row| {
            let values = values.iter().skip(row).step_by(rows).copied();
            match self {
                Self::Mean => values.map(|q| q / critics).sum(),
                Self::Min => values.fold(f32::INFINITY, min),
                Self::MeanMinusStd(kappa) => {
                    let mean = values.clone().map(|q| q / critics).sum::<f32>();
                    let variance = values.map(|q| (q - mean).powi(2) / critics).sum::<f32>();
                    mean - kappa * variance.sqrt()
                }
            }
        };
        (0..rows).map(aggregate).collect()
    }
}

/// Index of the largest score, the first of equals.
fn best(scores: &[f32]) -> usize {
    (1..scores.len()).fold(0, |best, i| if scores[i] > scores[best] { i } else { best })
}

/// An index drawn with a probability proportional to exp(score / temperature); `uniform` is in
/// [0, 1). Relative to the largest score nothing overflows, and infinite scores are equal.
fn draw(scores: &[f32], temperature: f32, uniform: f64) -> usize {
    let largest = scores[best(scores)];
    let weight = |score: &f32| match *score == largest {
        true => 1.0,
        false => (f64::from(score - largest) / f64::from(temperature)).exp(),
    };
    let weights: Vec<f64> = scores.iter().map(weight).collect();
    let mut left = uniform * weights.iter().sum::<f64>();
    let place = weights.iter().position(|weight| {
        left -= weight;
        left < 0.0
    });
    // Rounding can leave no weight for the last.
    place.unwrap_or(best(scores))
}

/// `count` indices, or all of fewer, drawn by [`draw`] without replacement.
fn draw_several(
    scores: &[f32],
    temperature: f32,
    count: usize,
    state: &mut EpisodeState,
) -> Vec<usize> {
    let count = count.min(scores.len());
    let mut sorted = scores.to_vec();
    sorted.sort_unstable_by(|x, y| y.total_cmp(x));
    let most = sorted[count - 1] + MOST_ABOVE * temperature;
    let mut left: Vec<f32> = scores.iter().map(|score| score.min(most)).collect();
    let mut places: Vec<usize> = (0..scores.len()).collect();
    let mut one = || {
        let drawn = draw(&left, temperature, state.uniform());
        left.remove(drawn);
        places.remove(drawn)
    };
    (0..count).map(|_| one()).collect()
}

impl FromStr for Aggregate {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let kappa = text.strip_prefix("mean-minus-std:");
        let kappa = kappa.and_then(|kappa| kappa.parse::<f32>().ok());
        match (text, kappa) {
            ("mean", _) => Ok(Self::Mean),
            ("min", _) => Ok(Self::Min),
            (_, Some(kappa)) if (0.0..=f32::MAX).contains(&kappa) => Ok(Self::MeanMinusStd(kappa)),
            _ => Err("one of mean, min and mean-minus-std:KAPPA, where KAPPA is at least 0"),
        }
    }
}

impl TryFrom<String> for Aggregate {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let error = |expected| format!("{text:?} is not {expected}");
        text.parse().map_err(error)
    }
}

impl From<Aggregate> for String {
    fn from(aggregate: Aggregate) -> Self {
        aggregate.to_string()
    }
}

/// `mean`, `min` or `mean-minus-std:1`.
impl fmt::Display for Aggregate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Mean => f.write_str("mean"),
            Self::Min => f.write_str("min"),
            Self::MeanMinusStd(kappa) => write!(f, "mean-minus-std:{kappa}"),
        }
    }
}

impl FromStr for Rule {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let expected = "one of best, softmax:TEMPERATURE, average:TEMPERATURE:ACTIONS and nearest";
        let temperature = |text: &str| text.parse().map_err(|_| expected);
        match text.split(':').collect::<Vec<_>>()[..] {
            ["best"] => Ok(Self::Best),
            ["nearest"] => Ok(Self::Nearest),
            ["softmax", number] => Ok(Self::softmax(temperature(number)?)),
            ["average", number, actions] => {
                let temperature = temperature(number)?;
                let actions = actions.parse().map_err(|_| expected)?;
                Ok(Self::Average { temperature, actions })
            }
            _ => Err(expected),
        }
    }
}

/// `best`, `softmax:0.1`, `average:0.01:4` or `nearest`.
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

/// `10 candidates`, then rule and aggregate where they are not the best by the mean, and guidance.
impl fmt::Display for Choice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.candidates {
            1 => write!(f, "1 candidate")?,
            many => write!(f, "{many} candidates")?,
        }
        if self.candidates > 1 && self.rule != Rule::Best {
            write!(f, ", {}", self.rule)?;
        }
        if self.candidates > 1 && self.aggregate != Aggregate::Mean {
            write!(f, ", {}", self.aggregate)?;
        }
        match self.guidance {
            0.0 => Ok(()),
            strength => write!(f, ", guidance {strength}"),
        }
    }
}

#[cfg(test)]
mod tests;
