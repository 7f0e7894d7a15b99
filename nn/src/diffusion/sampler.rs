//! The sampler's work on the CPU: a custom operation of (weights, observations, noise) that runs
//! the whole reverse process for one tile of rows after the other, so that activations stay in a
//! core's cache; tiles run in parallel.

use crate::layers::flat::TILE;
use crate::layers::mlp::{Kernels, Mlp, of_member};
use crate::layers::network::{Input, Network, rows_of};
use crate::layers::operation::{Arguments, Operation};
use crate::layers::workspace::with_workspace;

use crate::diffusion::schedule::Schedule;
use crate::shape::{NoiseShape, TIME_EMBEDDING};
use candle_core::{Result, Shape, Tensor};
use quad_kernels::product::product;
use rayon::prelude::*;
use std::sync::{Arc, OnceLock};

/// What does not change in training.
pub(crate) struct Parts {
    pub shape: NoiseShape,
    /// Embeds a denoising step.
    pub time: Mlp,
    /// Over [s, a^t, embedding].
    pub trunk: Mlp,
    pub schedule: Schedule,
    /// Sinusoids of t = 1..T, `T × 16`.
    pub features: Vec<f32>,
    /// A tensor of them, once it was needed.
    pub features_tensor: OnceLock<Tensor>,
}

/// The custom operation of (weights, observations, noise) that draws actions.
pub(crate) struct Sample {
    pub parts: Arc<Parts>,
    pub packed: Option<Arc<Kernels>>,
}

impl Parts {
    /// What each t = 1..T adds to the trunk's first pre-activation, its bias included: `T × width`.
    fn shifts(&self, weights: &[f32]) -> Vec<f32> {
        let NoiseShape { observation_dim, action_dim, diffusion_steps, .. } = self.shape;
        let mut embedding = vec![0.0; diffusion_steps * TIME_EMBEDDING];
        self.time.run(weights, None, &self.features, &mut embedding);
        let network = self.trunk.network(weights, 0);
        let mut shifts = vec![0.0; diffusion_steps * network.width()];
        let kernel = network.first_kernel(observation_dim + action_dim, TIME_EMBEDDING);
        product(&embedding, kernel, &mut shifts, TIME_EMBEDDING, network.width());
        for row in shifts.chunks_exact_mut(network.width()) {
            row.iter_mut().zip(network.bias(0)).for_each(|(x, b)| *x += b);
        }
        shifts
    }

    fn sample(&self, network: Network<'_>, given: Arguments<'_>, actions: &mut [f32]) {
        let Arguments { weights, observations, actions: noise, states, rows } = given;
        let NoiseShape { observation_dim, action_dim: a, diffusion_steps: steps, .. } = self.shape;
        let (shifts, width) = (self.shifts(weights), network.width());
        let kernel = network.first_kernel(observation_dim, a);
        let (all, repeat) = (actions.len(), rows / states);
        // A small batch is cut finer, so that every thread gets a share.
        let share = rows.div_ceil(rayon::current_num_threads()).clamp(1, TILE);
        let states = (share / repeat).max(1);
        let tile = states * repeat * a;
        actions.par_chunks_mut(tile).enumerate().for_each(|(i, actions)| {
            let observations = rows_of(observations, i * states, states, observation_dim);
            let len = observations.len() / observation_dim * width;
            with_workspace(|work| {
                work.with_base(len, actions.len(), |base, epsilon, work| {
                    network.first_part(observations, observation_dim, base);
                    actions.copy_from_slice(&noise[i * tile..][..actions.len()]);
                    for t in (1..=steps).rev() {
                        let shift = &shifts[(t - 1) * width..][..width];
                        network.forward(
                            Input { base, repeat, shift, actions, kernel },
                            work,
                            epsilon,
                        );
                        let z = if t > 1 {
                            &noise[(steps - t + 1) * all + i * tile..][..actions.len()]
                        } else {
                            &[]
                        };
                        self.schedule.reverse_in_place(t, actions, epsilon, z);
                    }
                });
            });
        });
    }
}

impl Operation for Sample {
    const NAME: &'static str = "sampler";

    fn forward(&self, given: Arguments<'_>) -> Result<(Vec<f32>, Shape)> {
        let action_dim = self.parts.shape.action_dim;
        let mut actions = vec![0.0; given.rows * action_dim];
        let packed = of_member(self.packed.as_deref(), 0);
        let network = Network { packed, ..self.parts.trunk.network(given.weights, 0) };
        self.parts.sample(network, given, &mut actions);
        Ok((actions, (given.rows, action_dim).into()))
    }
}
