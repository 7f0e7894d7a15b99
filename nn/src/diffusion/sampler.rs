//! The sampler on the CPU. It runs the whole reverse process for one tile of rows after the other,
//! whose activations stay in a core's cache; tiles run in parallel.

use crate::diffusion::schedule::Schedule;
use crate::layers::flat::TILE;
use crate::layers::mlp::{Kernels, Mlp};
use crate::layers::network::row_slice;
use crate::layers::workspace::with_workspace;
use crate::shape::{NoiseShape, TIME_EMBEDDING, TIME_FEATURES};
use candle_core::Tensor;
use quad_kernels::Precision::F32;
use quad_kernels::narrow::FirstLayer;
use quad_kernels::product::product;
use rayon::prelude::*;
use std::sync::OnceLock;

/// A noise predictor without its weights.
pub(crate) struct Architecture {
    pub shape: NoiseShape,
    /// Embeds a denoising step.
    pub time: Mlp,
    /// Over [s, a^t, embedding].
    pub trunk: Mlp,
    pub schedule: Schedule,
    /// Sinusoids of t = 0..T, `(1 + T) × 16`.
    pub features: Vec<f32>,
    /// `features` as a tensor, made when first needed.
    pub features_tensor: OnceLock<Tensor>,
    /// The coefficients of all reverse steps, made when first needed.
    #[cfg(feature = "cuda")]
    pub steps_tensor: OnceLock<Tensor>,
}

impl Architecture {
    /// The embedding's part of the trunk's first pre-activation plus bias, for t = 1..T: `T ×
    /// width`.
    fn shifts(&self, weights: &[f32]) -> Vec<f32> {
        let (network, shape) = (self.trunk.network(weights, 0), &self.shape);
        let mut embedding = vec![0.0; shape.diffusion_steps * TIME_EMBEDDING];
        let features = &self.features[TIME_FEATURES..];
        self.time.run(weights, None, features, &mut embedding);
        let width = network.width();
        let mut shifts = vec![0.0; shape.diffusion_steps * width];
        let before = shape.observation_dim + shape.action_dim;
        let kernel = network.first_kernel(before, TIME_EMBEDDING);
        product(F32, &embedding, kernel, &mut shifts, TIME_EMBEDDING, width);
        for row in shifts.chunks_exact_mut(width) {
            row.iter_mut().zip(network.bias(0)).for_each(|(x, b)| *x += b);
        }
        shifts
    }

    /// Draws actions, `rows × a`, for observations of `states` states and `noise`, `T × rows × a`.
    pub fn sample(
        &self,
        weights: &[f32],
        packed: Option<&Kernels>,
        (observations, states): (&[f32], usize),
        noise: &[f32],
    ) -> Vec<f32> {
        let (o, a) = (self.shape.observation_dim, self.shape.action_dim);
        let steps = self.shape.diffusion_steps;
        let network = self.trunk.packed_network(weights, packed, 0);
        let (shifts, width) = (self.shifts(weights), network.width());
        let kernel = network.first_kernel(o, a);
        let numbers = noise.len() / steps;
        let (rows, repeat) = (numbers / a, numbers / a / states);
        // A small batch is cut finer, so that every thread works.
        let share = rows.div_ceil(rayon::current_num_threads()).clamp(1, TILE);
        let states = (share / repeat).max(1);
        let tile = states * repeat * a;
        let mut actions = vec![0.0; numbers];
        let tiles = actions.par_chunks_mut(tile).enumerate();
        tiles.for_each(|(i, actions)| {
            let observations = row_slice(observations, i * states, states, o);
            let len = observations.len() / o * width;
            with_workspace(|work| {
                work.with_base(len, actions.len(), |base, epsilon, work| {
                    network.first_part(observations, o, base);
                    actions.copy_from_slice(&noise[i * tile..][..actions.len()]);
                    for t in (1..=steps).rev() {
                        let shift = &shifts[(t - 1) * width..][..width];
                        let first = FirstLayer { base, repeat, shift, actions, kernel };
                        network.forward(first, work, epsilon);
                        let z = match t {
                            1 => &[],
                            _ => &noise[(steps - t + 1) * numbers + i * tile..][..actions.len()],
                        };
                        self.schedule.reverse_in_place(t, actions, epsilon, z);
                    }
                });
            });
        });
        actions
    }
}
