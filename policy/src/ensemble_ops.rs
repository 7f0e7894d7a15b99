//! What an ensemble computes without keeping anything: custom operations of (weights, observations, actions) on the CPU, cut
//! into (member, tile of rows), in parallel.

use crate::layers::TILE;
use crate::mlp::Mlp;
use crate::network::{Input, Network, rows_of, with_workspace};
use crate::operation::{Arguments, Operation};
use crate::rounded::Kernels;
use candle_core::{Result, Shape};
use rayon::prelude::*;
use std::sync::Arc;

/// Networks over [s, a].
pub(crate) struct Networks {
    pub mlp: Mlp,
    pub observation_dim: usize,
    pub action_dim: usize,
}

impl Networks {
    fn members(&self) -> usize {
        self.mlp.layers.members
    }

    /// Cuts `out`, `K × rows × width`, into tiles of rows that do not part the actions of a state, and has `work` fill
    /// them in parallel: it gets the member's network, the tile's observations and actions, and the tile.
    fn for_each_tile(
        &self,
        given: Arguments<'_>,
        out: &mut [f32],
        work: impl Fn(Network<'_>, &[f32], &[f32], &mut [f32]) + Sync,
    ) {
        let repeat = given.rows / given.states;
        let states = (TILE / repeat).max(1);
        let (tile, width) = (states * repeat, out.len() / (self.members() * given.rows));
        out.par_chunks_mut(given.rows * width).enumerate().for_each(|(k, out)| {
            let network = self.mlp.network(given.weights, k);
            out.par_chunks_mut(tile * width).enumerate().for_each(|(i, out)| {
                let observations = rows_of(given.observations, i * states, states, self.observation_dim);
                work(network, observations, rows_of(given.actions, i * tile, tile, self.action_dim), out);
            });
        });
    }
}

/// What comes out of the networks: `K × rows × outputs`.
pub(crate) struct Values {
    pub networks: Networks,
    pub rounded: Option<Arc<Kernels>>,
}

impl Operation for Values {
    const NAME: &'static str = "ensemble";

    fn forward(&self, given: Arguments<'_>) -> Result<(Vec<f32>, Shape)> {
        let (members, outputs) = (self.networks.members(), self.networks.mlp.layers.outputs());
        let Networks { observation_dim, action_dim, .. } = self.networks;
        let mut out = vec![0.0; members * given.rows * outputs];
        let repeat = given.rows / given.states;
        self.networks.for_each_tile(given, &mut out, |network, states, actions, out| {
            let rounded = self.rounded.as_ref().and_then(|rounded| rounded.get(network.member)).map(Vec::as_slice);
            with_workspace(|work| {
                work.with_base(states.len() / observation_dim * network.width(), 0, |base, _, work| {
                    network.first_part(states, observation_dim, base);
                    let (shift, kernel) = (network.bias(0), network.first_kernel(observation_dim, action_dim));
                    let input = Input { base, repeat, shift, actions, kernel };
                    Network { rounded, ..network }.forward(input, work, out);
                });
            });
        });
        Ok((out, (members, given.rows, outputs).into()))
    }
}

/// ∇_a Q_k(s, a): `K × rows × a`, worked out tile by tile, while a tile's activations are in a core's cache.
pub(crate) struct ActionGradients {
    pub networks: Networks,
}

impl Operation for ActionGradients {
    const NAME: &'static str = "action-gradients";

    fn forward(&self, given: Arguments<'_>) -> Result<(Vec<f32>, Shape)> {
        let Networks { ref mlp, observation_dim, action_dim } = self.networks;
        let (members, repeat) = (self.networks.members(), given.rows / given.states);
        let mut out = vec![0.0; members * given.rows * action_dim];
        self.networks.for_each_tile(given, &mut out, |network, states, actions, out| {
            let rows = out.len() / action_dim;
            let mut x = Vec::with_capacity(rows * (observation_dim + action_dim));
            for (row, action) in actions.chunks_exact(action_dim).enumerate() {
                x.extend_from_slice(&states[row / repeat * observation_dim..][..observation_dim]);
                x.extend_from_slice(action);
            }
            with_workspace(|work| {
                work.with_activations(rows, mlp.layers.hidden(), |left, work| {
                    let mut values = vec![0.0; rows];
                    network.forward_saving(&x, left, work, &mut values);
                    values.fill(1.0);
                    network.backward(&values, &mut left.slope, work);
                    network.input_gradient(left.slope[0], (observation_dim, action_dim), out);
                });
            });
        });
        Ok((out, (members, given.rows, action_dim).into()))
    }
}
