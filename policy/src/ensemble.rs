//! The critic ensemble Q_1..Q_K: values, regression towards targets, gradients at actions.
//!
//! Work is cut into (critic, tile of rows) and runs in parallel; the cut does not depend on the number of threads, so
//! neither do the results.

use crate::matmul::Rounded;
use crate::mlp::Mlp;
use crate::network::{Input, Network, TILE, concatenate, with_workspace};
use crate::{Architecture, Precision};
use rayon::prelude::*;

/// Shapes of an ensemble; its parameters are a flat slice, critic after critic.
#[derive(Clone, Debug)]
pub struct CriticEnsemble {
    network: Network,
    critics: usize,
}

/// A batch of states, each with `repeat` actions.
#[derive(Clone, Copy, Debug)]
pub struct StateActions<'a> {
    /// `states × observation_dim`.
    pub observations: &'a [f32],
    /// `states × repeat × action_dim`.
    pub actions: &'a [f32],
    /// Actions per state.
    pub repeat: usize,
}

/// An ensemble's hidden kernels as a [`Precision`] wants them, critic after critic; none in f32.
pub struct RoundedCritics(Vec<[Rounded; 2]>);

impl CriticEnsemble {
    /// The ensemble of an architecture.
    pub fn new(architecture: &Architecture) -> Self {
        let network = Network {
            mlp: Mlp::new(&architecture.critic_widths()),
            observation_dim: architecture.observation_dim,
            action_dim: architecture.action_dim,
            hidden: architecture.hidden,
        };
        Self { network, critics: architecture.critics }
    }

    /// Parameters of one critic.
    pub fn parameters_per_critic(&self) -> usize {
        self.network.mlp.len()
    }

    /// Parameters of all.
    pub fn parameters(&self) -> usize {
        self.critics * self.network.mlp.len()
    }

    fn critic<'a>(&self, parameters: &'a [f32], k: usize) -> &'a [f32] {
        let len = self.network.mlp.len();
        &parameters[k * len..][..len]
    }

    /// Prepares parameters for [`Self::values`].
    pub fn round(&self, parameters: &[f32], precision: Precision) -> RoundedCritics {
        let round = |k| self.network.round(self.critic(parameters, k));
        let critics = if precision == Precision::Bf16 { self.critics } else { 0 };
        RoundedCritics((0..critics).into_par_iter().filter_map(round).collect())
    }

    /// `out[K × rows] = Q_k(s, a)`, a row for each action. `rounded` is of the same parameters.
    pub fn values(&self, parameters: &[f32], rounded: &RoundedCritics, input: StateActions<'_>, out: &mut [f32]) {
        let network = &self.network;
        let rows = input.actions.len() / network.action_dim;
        let states = (TILE / input.repeat).max(1);
        let tile = states * input.repeat;
        out.par_chunks_mut(rows).enumerate().for_each(|(k, out)| {
            let parameters = self.critic(parameters, k);
            let (shift, rounded) = (network.mlp.bias(parameters, 0), rounded.0.get(k));
            out.par_chunks_mut(tile).enumerate().for_each(|(i, out)| {
                let observations = part(input.observations, i * states, states, network.observation_dim);
                let actions = part(input.actions, i * tile, tile, network.action_dim);
                with_workspace(|work| {
                    let mut base = std::mem::take(&mut work.base);
                    let len = observations.len() / network.observation_dim * network.hidden;
                    network.state_part(parameters, observations, base.sized(len));
                    let input = Input { base: base.first(len), repeat: input.repeat, shift, actions };
                    network.forward(parameters, rounded, input, work, out);
                    work.base = base;
                });
            });
        });
    }

    /// One pass of Σ_k Σ_rows (Q_k(s, a) - y)² · `scale`: returns the sum and writes the gradient.
    ///
    /// `gradient` holds the critics' flat gradients once per tile of 128 rows (see [`Self::gradient_tiles`]); the
    /// gradient is their sum.
    pub fn regress(
        &self,
        parameters: &[f32],
        observations: &[f32],
        actions: &[f32],
        targets: &[f32],
        scale: f32,
        gradient: &mut [f32],
    ) -> f32 {
        let network = &self.network;
        let dims = (network.observation_dim, network.action_dim);
        gradient
            .par_chunks_mut(network.mlp.len())
            .enumerate()
            .map(|(task, gradient)| {
                let (i, k) = (task / self.critics, task % self.critics);
                let parameters = self.critic(parameters, k);
                let observations = part(observations, i * TILE, TILE, dims.0);
                let actions = part(actions, i * TILE, TILE, dims.1);
                let targets = part(targets, i * TILE, TILE, 1);
                with_workspace(|work| {
                    let (mut base, mut input, mut out) = (
                        std::mem::take(&mut work.base),
                        std::mem::take(&mut work.input),
                        std::mem::take(&mut work.out),
                    );
                    let len = targets.len() * network.hidden;
                    network.state_part(parameters, observations, base.sized(len));
                    let shift = network.mlp.bias(parameters, 0);
                    let tile = Input { base: base.first(len), repeat: 1, shift, actions };
                    let values = out.sized(targets.len());
                    network.forward_recorded(parameters, tile, work, values);
                    let mut loss = 0.0;
                    for (q, y) in values.iter_mut().zip(targets) {
                        let error = *q - y;
                        loss += scale * error * error;
                        *q = 2.0 * scale * error;
                    }
                    network.backward(parameters, values, work);
                    concatenate(observations, actions, dims, &mut input);
                    network.parameter_gradient(&input, values, work, gradient);
                    (work.base, work.input, work.out) = (base, input, out);
                    loss
                })
            })
            .collect::<Vec<f32>>()
            .iter()
            .sum()
    }

    /// Copies of the gradient that [`Self::regress`] writes for a batch.
    pub fn gradient_tiles(&self, batch: usize) -> usize {
        batch.div_ceil(TILE)
    }

    /// `gradients[K × rows × action_dim] = ∇_a Q_k(s, a)`.
    pub fn action_gradients(&self, parameters: &[f32], observations: &[f32], actions: &[f32], gradients: &mut [f32]) {
        let network = &self.network;
        let (o, a) = (network.observation_dim, network.action_dim);
        gradients.par_chunks_mut(actions.len()).enumerate().for_each(|(k, gradients)| {
            let parameters = self.critic(parameters, k);
            let shift = network.mlp.bias(parameters, 0);
            gradients.par_chunks_mut(TILE * a).enumerate().for_each(|(i, gradients)| {
                let rows = gradients.len() / a;
                let observations = part(observations, i * TILE, TILE, o);
                let actions = part(actions, i * TILE, TILE, a);
                with_workspace(|work| {
                    let (mut base, mut out) = (std::mem::take(&mut work.base), std::mem::take(&mut work.out));
                    network.state_part(parameters, observations, base.sized(rows * network.hidden));
                    let input = Input { base: base.first(rows * network.hidden), repeat: 1, shift, actions };
                    let ones = out.sized(rows);
                    network.forward_recorded(parameters, input, work, ones);
                    ones.fill(1.0);
                    network.backward(parameters, ones, work);
                    network.action_gradient(parameters, work, gradients);
                    (work.base, work.out) = (base, out);
                });
            });
        });
    }
}

/// Rows `from .. from + count` (or fewer, at the end) of a matrix with `width` columns.
pub(crate) fn part(matrix: &[f32], from: usize, count: usize, width: usize) -> &[f32] {
    let end = ((from + count) * width).min(matrix.len());
    &matrix[from * width..end]
}
