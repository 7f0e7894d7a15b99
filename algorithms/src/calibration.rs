//! The lower bounds of Cal-QL (Nakamoto et al. 2023, "Cal-QL: Calibrated Offline RL Pre-Training for
//! Efficient Online Fine-Tuning"): the Monte-Carlo returns of the data's policy.

use candle_core::{Device, Result, Tensor};
use quad_dataset::{Batch, Transitions};

/// Discounted returns from each transition to its episode's end.
pub(super) struct MonteCarlo {
    gamma: f64,
    /// By index: of the dataset, then of experience.
    returns: Vec<f32>,
}

impl MonteCarlo {
    pub fn new(transitions: &Transitions, gamma: f32) -> Self {
        let mut returns = Self { gamma: f64::from(gamma), returns: Vec::new() };
        returns.extend(transitions, transitions.episodes());
        returns
    }

    /// Adds the returns of experience that has come since.
    pub fn follow(&mut self, transitions: &Transitions) {
        if self.returns.len() < transitions.len() + transitions.experience_len() {
            self.extend(transitions, transitions.experience_episodes());
        }
    }

    /// The returns of transitions, `[B]`.
    pub fn of(&self, indices: &[u32], device: &Device) -> Result<Tensor> {
        let returns = indices.iter().map(|index| self.returns[*index as usize]);
        Tensor::from_iter(returns, device)
    }

    fn extend(&mut self, transitions: &Transitions, episodes: Vec<std::ops::Range<u32>>) {
        let mut batch = Batch::default();
        let done = self.returns.len() as u32;
        for episode in episodes.into_iter().filter(|episode| episode.start >= done) {
            transitions.gather(&Vec::from_iter(episode), &mut batch);
            let terminates = batch.masks.last() == Some(&0.0);
            self.returns.extend(discounted(&batch.rewards, terminates, self.gamma));
        }
    }
}

/// The returns of an episode. One of two or more equal rewards that does not terminate has not reached
/// its goal: its return is that of this reward forever, which γ < 1 makes finite.
fn discounted(rewards: &[f32], terminates: bool, gamma: f64) -> Vec<f32> {
    let failed = rewards.len() > 1 && !terminates;
    if failed && gamma < 1.0 && rewards.iter().all(|reward| *reward == rewards[0]) {
        return vec![(f64::from(rewards[0]) / (1.0 - gamma)) as f32; rewards.len()];
    }
    let (mut returns, mut after) = (rewards.to_vec(), 0.0);
    for reward in returns.iter_mut().rev() {
        after = f64::from(*reward) + gamma * after;
        *reward = after as f32;
    }
    returns
}

#[cfg(test)]
mod tests {
    use super::*;
    use quad_dataset::{Arrays, OnlineEpisode};

    #[test]
    fn returns_without_a_discount_are_finite() {
        assert_eq!(discounted(&[0.0, 0.0], false, 1.0), [0.0, 0.0]);
        assert_eq!(discounted(&[1.0, 1.0], false, 1.0), [2.0, 1.0]);
    }

    #[test]
    fn returns_reach_to_the_end_of_episodes_and_follow_experience() {
        let arrays = Arrays {
            observation_dim: 1,
            action_dim: 1,
            observations: vec![0.0, 1.0, 0.0, 1.0, 0.0],
            next_observations: vec![1.0, 2.0, 1.0, 2.0, 1.0],
            actions: vec![0.0; 5],
            rewards: vec![1.0, 4.0, -1.0, -1.0, -3.0],
            terminals: vec![false, true, false, false, false],
            timeouts: vec![false, false, false, true, true],
        };
        let transitions = Transitions::of(arrays).unwrap();
        let mut returns = MonteCarlo::new(&transitions, 0.5);
        let mut expected = vec![3.0, 4.0, -2.0, -2.0, -3.0];
        assert_eq!(returns.returns, expected);
        let online = |rewards: &'static [f32], terminated| OnlineEpisode {
            observations: &[0.0, 1.0, 2.0],
            actions: &[0.0; 2],
            rewards,
            terminated,
        };
        for (rewards, terminated, more) in
            [(&[0.0, 2.0], true, [1.0, 2.0]), (&[-1.0, -1.0], false, [-2.0, -2.0])]
        {
            transitions.add_episode(online(rewards, terminated)).unwrap();
            returns.follow(&transitions);
            expected.extend(more);
            assert_eq!(returns.returns, expected);
        }
        let of = returns.of(&[8, 0], &Device::Cpu).unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(of, [-2.0, 3.0]);
    }
}
