//! Returns of a dataset's episodes: discounted, as Cal-QL bounds values by them, and as SfBC's
//! critics learn them: standardized, and planned anew with values of states.

use super::state_dict::StateDict;
use candle_core::{DType, Device, Result, Tensor};
use std::ops::Range;

/// Discounted sums of rewards to the end of an episode; `after` is added to the last reward.
pub(super) fn discounted(rewards: &[f32], gamma: f64, mut after: f64) -> Vec<f64> {
    let (mut returns, mut discount) = (vec![0.0; rewards.len()], 1.0);
    for (value, reward) in returns.iter_mut().zip(rewards).rev() {
        after = f64::from(*reward) + discount * after;
        (*value, discount) = (after, gamma);
    }
    returns
}

/// The lower bounds of an episode's values in Cal-QL (Nakamoto et al. 2023, "Cal-QL: Calibrated
/// Offline RL Pre-Training for Efficient Online Fine-Tuning"). One of two or more equal rewards that
/// does not terminate has not reached its goal: its return is that of this reward forever, which γ <
/// 1 makes finite.
pub(super) fn calibrated(rewards: &[f32], terminates: bool, gamma: f64) -> Vec<f32> {
    let failed = rewards.len() > 1 && !terminates;
    if failed && gamma < 1.0 && rewards.iter().all(|reward| *reward == rewards[0]) {
        return vec![(f64::from(rewards[0]) / (1.0 - gamma)) as f32; rewards.len()];
    }
    let returns = discounted(rewards, gamma, 0.0).into_iter();
    returns.map(|value| value as f32).collect()
}

/// Least divisor of the returns.
const LEAST_DEVIATION: f64 = 0.1;

/// The returns of n transitions, on the CPU.
pub(super) struct Returns {
    gamma: f64,
    rewards: Vec<f32>,
    /// Ranges of the episodes among the transitions.
    pub episodes: Vec<Range<usize>>,
    /// V(s) of the states that were planned so far, `[n]`.
    values: Tensor,
    /// Standardized returns, `[n]`.
    pub targets: Tensor,
    /// Mean and standard deviation of the returns before they were standardized, `[2]`.
    scale: Tensor,
}

impl Returns {
    /// The returns to the episodes' ends, discounted by `gamma`.
    pub fn new(rewards: Vec<f32>, episodes: Vec<Range<usize>>, gamma: f32) -> Result<Self> {
        let zeros = |count: usize| Tensor::zeros(count, DType::F32, &Device::Cpu);
        let mut returns = Self {
            gamma: f64::from(gamma),
            values: zeros(rewards.len())?,
            targets: zeros(rewards.len())?,
            scale: zeros(2)?,
            rewards,
            episodes,
        };
        returns.standardize(&returns.planned(None))?;
        Ok(returns)
    }

    /// Standardized values `[m]` in units of the return.
    pub fn unscaled(&self, values: &Tensor) -> Result<Tensor> {
        let scale: Vec<f32> = self.scale.to_vec1()?;
        values.affine(f64::from(scale[1]), f64::from(scale[0]))
    }

    /// Sets values `[m]` of the states from number `first` on, in units of the return.
    pub fn keep(&mut self, values: &Tensor, first: usize) -> Result<()> {
        self.values.slice_set(&values.to_device(&Device::Cpu)?, 0, first)
    }

    /// The mean value of a range of states, if it is not empty.
    pub fn mean_value(&self, states: Range<usize>) -> Result<Option<f32>> {
        let values = self.values.narrow(0, states.start, states.len())?;
        let values: Vec<f32> = values.to_vec1()?;
        Ok((!values.is_empty()).then(|| values.iter().sum::<f32>() / values.len() as f32))
    }

    /// Plans new returns with the values of all states.
    pub fn plan(&mut self) -> Result<()> {
        let returns = self.planned(Some(&self.values.to_vec1()?));
        self.standardize(&returns)
    }

    /// Returns backwards through each episode: R_i = r_i + γ·R_{i+1}, or the state's value if that
    /// is larger.
    fn planned(&self, values: Option<&[f32]>) -> Vec<f64> {
        let mut returns = vec![0.0; self.rewards.len()];
        for episode in &self.episodes {
            let mut after = 0.0;
            for i in episode.clone().rev() {
                after = f64::from(self.rewards[i]) + self.gamma * after;
                if let Some(value) = values.map(|values| f64::from(values[i]))
                    && (value > after || value.is_nan())
                {
                    after = value;
                }
                returns[i] = after;
            }
        }
        returns
    }

    fn standardize(&mut self, returns: &[f64]) -> Result<()> {
        let count = returns.len() as f64;
        let mean = returns.iter().sum::<f64>() / count;
        let deviation = (returns.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / count).sqrt();
        let deviation = deviation.clamp(LEAST_DEVIATION, f64::INFINITY); // keeps a NaN
        let targets = returns.iter().map(|x| ((x - mean) / deviation) as f32);
        self.targets = Tensor::from_iter(targets, &Device::Cpu)?;
        self.scale = Tensor::new(&[mean as f32, deviation as f32], &Device::Cpu)?;
        Ok(())
    }

    /// Adds what planning changes.
    pub fn add_to<'a>(&'a mut self, dict: StateDict<'a>) -> StateDict<'a> {
        let dict = dict.with("values", &mut self.values).with("targets", &mut self.targets);
        dict.with("scale", &mut self.scale)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn returns_reach_to_the_end_of_an_episode_and_plans_improve_them() {
        let (rewards, episodes) = (vec![1.0, 2.0, 0.0, 0.0, 4.0], vec![0..2, 2..5]);
        let mut returns = Returns::new(rewards, episodes, 0.5).unwrap();
        assert_eq!(returns.planned(None), [2.0, 2.0, 1.0, 2.0, 4.0]);
        let targets: Vec<f32> = returns.targets.to_vec1().unwrap();
        assert!((targets[4] - 1.8 / 0.96f32.sqrt()).abs() < 1e-6, "{targets:?}");
        let unscaled = returns.unscaled(&returns.targets).unwrap();
        let unscaled: Vec<f32> = unscaled.to_vec1().unwrap();
        assert!((unscaled[4] - 4.0).abs() < 1e-6, "{unscaled:?}");
        // A value counts where it is larger, and so does it for what came before.
        let values = [0.0, 6.0, 0.0, 1.0, 4.5];
        assert_eq!(returns.planned(Some(&values)), [4.0, 6.0, 1.125, 2.25, 4.5]);
        returns.keep(&Tensor::new(&values[3..], &Device::Cpu).unwrap(), 3).unwrap();
        assert_eq!(returns.mean_value(2..5).unwrap(), Some(5.5 / 3.0));
        assert!(returns.planned(Some(&[0.0, f32::NAN, 0.0, 0.0, 0.0]))[0].is_nan());
    }

    #[test]
    fn returns_without_a_discount_are_finite() {
        assert_eq!(calibrated(&[0.0, 0.0], false, 1.0), [0.0, 0.0]);
        assert_eq!(calibrated(&[1.0, 1.0], false, 1.0), [2.0, 1.0]);
    }

    #[test]
    fn returns_that_hardly_differ_are_not_blown_up() {
        let returns = Returns::new(vec![1.0, 1.001], vec![0..1, 1..2], 0.5).unwrap();
        let targets: Vec<f32> = returns.targets.to_vec1().unwrap();
        assert!((targets[1] - 0.005).abs() < 1e-5, "{targets:?}");
    }
}
