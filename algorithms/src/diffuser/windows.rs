//! Windows of consecutive transitions, standardized, with the returns from their first steps.

use crate::context::Context;
use crate::error::AlgorithmError;
use candle_core::{Result, Tensor};
use quad_dataset::Transitions;
use quad_nn::Scaling;
use std::sync::Arc;

pub(super) struct Windows {
    transitions: Arc<Transitions>,
    /// Steps in a window, H.
    horizon: usize,
    units: Scaling,
    windows: Vec<Window>,
}

struct Window {
    first: u32,
    /// Transitions: H, or fewer where the episode terminates.
    length: u32,
    /// Σ γ^k·r_k from the first transition to the end of the episode.
    value: f32,
}

/// A batch of B windows.
pub(super) struct Batch {
    /// [action, state] of each step, `[B, H, a + o]`.
    pub windows: Tensor,
    /// `[B]`.
    pub returns: Tensor,
}

impl Windows {
    /// All windows of H steps within an episode, and those that run past the end of one that
    /// terminates; `penalty` is taken off the last reward there.
    pub fn new(
        context: &Context,
        horizon: usize,
        gamma: f32,
        penalty: f32,
    ) -> std::result::Result<Self, AlgorithmError> {
        let transitions = context.transitions.clone();
        let (mut windows, mut episode) = (Vec::new(), quad_dataset::Batch::default());
        for range in transitions.episodes() {
            let first = range.start;
            transitions.gather(&Vec::from_iter(range), &mut episode);
            let terminates = episode.masks.last() == Some(&0.0);
            let mut value = if terminates { -f64::from(penalty) } else { 0.0 };
            let mut of_episode = Vec::new();
            for (step, reward) in episode.rewards.iter().enumerate().rev() {
                // The penalty belongs to the last reward: it is not discounted there.
                let discount = if step + 1 == episode.size { 1.0 } else { f64::from(gamma) };
                value = f64::from(*reward) + discount * value;
                let length = (episode.size - step).min(horizon);
                if terminates || length == horizon {
                    let (first, length) = (first + step as u32, length as u32);
                    of_episode.push(Window { first, length, value: value as f32 });
                }
            }
            windows.extend(of_episode.into_iter().rev());
        }
        match windows.is_empty() {
            true => Err(AlgorithmError::NoWindow(horizon)),
            false => {
                Ok(Self { units: transitions.standard_units(), transitions, horizon, windows })
            }
        }
    }

    pub fn count(&self) -> usize {
        self.windows.len()
    }

    pub fn units(&self) -> &Scaling {
        &self.units
    }

    /// The windows with these indices. After the end of an episode there are zeros, in the data's
    /// units.
    pub fn batch(&self, indices: &[u32], context: &Context) -> Result<Batch> {
        #[cfg(test)]
        if let Some(golden) = &context.golden {
            let [windows, returns] =
                ["windows", "returns"].map(|name| golden[name].to_device(&context.device));
            return Ok(Batch { windows: windows?, returns: returns? });
        }
        let windows: Vec<&Window> =
            indices.iter().map(|index| &self.windows[*index as usize]).collect();
        let rows: Vec<u32> =
            windows.iter().flat_map(|window| window.first..window.first + window.length).collect();
        let mut batch = quad_dataset::Batch::default();
        self.transitions.gather(&rows, &mut batch);
        let padded = |numbers: &[f32], width: usize| {
            let (mut out, mut rest) =
                (Vec::with_capacity(indices.len() * self.horizon * width), numbers);
            for (i, window) in windows.iter().enumerate() {
                let (mine, others) = rest.split_at(window.length as usize * width);
                out.extend_from_slice(mine);
                out.resize((i + 1) * self.horizon * width, 0.0);
                rest = others;
            }
            out
        };
        let (o, a) = (self.transitions.observation_dim(), self.transitions.action_dim());
        let (mut observations, mut actions) =
            (padded(&batch.observations, o), padded(&batch.actions, a));
        for (affine, numbers) in
            [(&self.units.observations, &mut observations), (&self.units.actions, &mut actions)]
        {
            affine.iter().for_each(|affine| affine.to_network(numbers));
        }
        let steps = actions.chunks_exact(a).zip(observations.chunks_exact(o));
        let numbers: Vec<f32> =
            steps.flat_map(|(action, state)| action.iter().chain(state)).copied().collect();
        let returns: Vec<f32> = windows.iter().map(|window| window.value).collect();
        Ok(Batch {
            windows: Tensor::from_vec(
                numbers,
                (indices.len(), self.horizon, a + o),
                &context.device,
            )?,
            returns: Tensor::from_vec(returns, indices.len(), &context.device)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Device;
    use quad_dataset::{Arrays, Window};
    use quad_nn::Precision;

    use super::*;

    #[test]
    fn a_window_has_the_discounted_rewards_to_the_end_of_its_episode() {
        let transitions = Transitions::of(Arrays {
            observation_dim: 1,
            action_dim: 1,
            observations: vec![0.0, 1.0, 2.0, 0.0, 1.0, 2.0],
            actions: vec![0.0; 6],
            rewards: vec![1.0, 2.0, 4.0, 1.0, 2.0, 4.0],
            next_observations: vec![1.0, 2.0, 3.0, 1.0, 2.0, 3.0],
            terminals: vec![false, false, true, false, false, false],
            timeouts: vec![false, false, false, false, false, true],
        });
        let context = Context {
            transitions: Arc::new(transitions.unwrap()),
            batch_size: 1,
            total_steps: 1,
            online_steps: 0,
            window: Window::ONE,
            seed: 0,
            precision: Precision::F32,
            device: Device::Cpu,
            golden: None,
        };
        let windows = Windows::new(&context, 2, 0.5, 8.0).unwrap().windows;
        let windows = windows.iter().map(|window| (window.first, window.length, window.value));
        // The episode that is cut off has full windows alone.
        let expected = [(0, 2, 1.0), (1, 2, 0.0), (2, 1, -4.0), (3, 2, 3.0), (4, 2, 4.0)];
        assert_eq!(Vec::from_iter(windows), expected);
    }
}
