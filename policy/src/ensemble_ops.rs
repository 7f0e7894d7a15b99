//! An ensemble's work on the CPU: custom operations of (weights, observations, actions).
//!
//! It is cut into (member, tile of rows) and runs in parallel; the cut does not depend on the number of threads, so neither
//! do the results.

use crate::layers::{LayerMut, Layers};
use crate::network::{Input, Network, TILE, rows_of, with_workspace};
use crate::operation::{Arguments, Operation};
use crate::saved::{Lent, SavedActivations, concatenate, layer_gradient};
use crate::shape::EnsembleShape;
use crate::weights::KeptGradient;
use candle_core::{Result, Shape};
use quad_kernels::optimiser::weighted_sum;
use quad_kernels::product::Rounded;
use rayon::prelude::*;
use std::sync::Arc;

/// Where an ensemble's networks lie in its vector of weights.
pub(crate) struct Networks {
    pub shape: EnsembleShape,
    pub layers: Layers,
}

impl Networks {
    pub fn member<'a>(&'a self, weights: &'a [f32], k: usize) -> Network<'a> {
        Network::new(weights, &self.layers, k, (self.shape.observation_dim, self.shape.action_dim))
    }

    /// Cuts `out`, `K × rows × width`, into tiles of rows that do not part the actions of a state, and has `work` fill
    /// them in parallel: it gets the member's number and network, the tile's observations and actions, and the tile.
    fn for_each_tile(
        &self,
        given: Arguments<'_>,
        out: &mut [f32],
        work: impl Fn(usize, Network<'_>, &[f32], &[f32], &mut [f32]) + Sync,
    ) {
        let EnsembleShape { members, observation_dim, action_dim, .. } = self.shape;
        let repeat = given.rows / given.states;
        let states = (TILE / repeat).max(1);
        let (tile, width) = (states * repeat, out.len() / (members * given.rows));
        out.par_chunks_mut(given.rows * width).enumerate().for_each(|(k, out)| {
            let network = self.member(given.weights, k);
            out.par_chunks_mut(tile * width).enumerate().for_each(|(i, out)| {
                let observations = rows_of(given.observations, i * states, states, observation_dim);
                work(k, network, observations, rows_of(given.actions, i * tile, tile, action_dim), out);
            });
        });
    }

    /// Runs all members forward, tile by tile, and keeps what the backward pass needs.
    fn forward_saving(&self, given: Arguments<'_>, saved: &mut SavedActivations, out: &mut [f32]) {
        let EnsembleShape { members, observation_dim, action_dim, hidden, .. } = self.shape;
        saved.resize(members, given.rows, hidden);
        saved.tiles(out).into_par_iter().for_each(|mut tile| {
            let network = self.member(given.weights, tile.member);
            let observations = rows_of(given.observations, tile.index * TILE, TILE, observation_dim);
            let actions = rows_of(given.actions, tile.index * TILE, TILE, action_dim);
            with_workspace(|work| {
                work.with_base(observations.len() / observation_dim * hidden, 0, |base, _, work| {
                    network.state_part(observations, base);
                    let input = Input { base, repeat: 1, shift: network.bias(0), actions };
                    network.forward_saving(input, &mut tile.activations, work.scratch(), tile.out);
                });
            });
        });
    }

    /// Goes from the outputs' gradient, `K × rows × outputs`, back to those before each activation.
    fn back(&self, weights: &[f32], saved: &mut SavedActivations, output_gradient: &mut [f32]) {
        saved.tiles(output_gradient).into_par_iter().for_each(|mut tile| {
            let network = self.member(weights, tile.member);
            with_workspace(|work| network.backward(tile.out, &mut tile.activations.slope, work.scratch()));
        });
    }
}

/// What comes out of the networks: `K × rows × outputs`.
pub(crate) struct Outputs {
    pub networks: Arc<Networks>,
    pub rounded: Option<Arc<Vec<[Rounded; 2]>>>,
    /// For a backward pass to the weights: where their gradient is left, and what is kept for it.
    pub saved: Option<(Arc<KeptGradient>, Lent<SavedActivations>)>,
}

impl Operation for Outputs {
    const NAME: &'static str = "ensemble";

    fn forward(&self, given: Arguments<'_>) -> Result<(Vec<f32>, Shape)> {
        let EnsembleShape { members, observation_dim, hidden, outputs, .. } = self.networks.shape;
        let mut out = vec![0.0; members * given.rows * outputs];
        if let Some((_, lent)) = &self.saved {
            self.networks.forward_saving(given, &mut lent.lock(), &mut out);
        } else {
            let repeat = given.rows / given.states;
            self.networks.for_each_tile(given, &mut out, |k, network, states, actions, out| {
                let rounded = self.rounded.as_ref().and_then(|rounded| rounded.get(k));
                with_workspace(|work| {
                    work.with_base(states.len() / observation_dim * hidden, 0, |base, _, work| {
                        network.state_part(states, base);
                        let input = Input { base, repeat, shift: network.bias(0), actions };
                        network.with_rounded(rounded).forward(input, work, out);
                    });
                });
            });
        }
        Ok((out, (members, given.rows, outputs).into()))
    }

    fn backward(&self, given: Arguments<'_>, gradient: &[f32]) -> Result<()> {
        let Some((kept, lent)) = &self.saved else { return Ok(()) };
        let EnsembleShape { observation_dim, action_dim, .. } = self.networks.shape;
        let input = concatenate(given.observations, given.actions, (observation_dim, action_dim));
        let mut saved = lent.lock();
        // The copy is cut up; the other is read as a whole.
        self.networks.back(given.weights, &mut saved, &mut gradient.to_vec());
        kept.write(|out| saved.weight_gradients(self.networks.layers.split_mut(out), &input, gradient))
    }
}

/// Mean over members and rows of (Q_k(s, a) - y)². As soon as a tile's errors are known, its backward pass begins, while its
/// activations are at hand; what is left for later is to add up the tiles' gradients.
pub(crate) struct SquaredError {
    pub networks: Arc<Networks>,
    pub targets: Vec<f32>,
    pub kept: Arc<KeptGradient>,
    /// The gradient of each tile of rows, one after the other.
    pub of_tiles: Lent<Vec<f32>>,
}

impl SquaredError {
    /// One tile of one member: its share of the loss, and the gradient of its layers.
    fn tile(&self, network: Network<'_>, rows: (&[f32], &[f32], &[f32]), scale: f32, layers: Vec<LayerMut<'_>>) -> f32 {
        let EnsembleShape { observation_dim, action_dim, hidden, .. } = self.networks.shape;
        let (observations, actions, targets) = rows;
        let (count, len) = (targets.len(), targets.len() * hidden);
        with_workspace(|work| {
            work.with_base(len, count, |base, values, work| {
                network.state_part(observations, base);
                let input = Input { base, repeat: 1, shift: network.bias(0), actions };
                let (mut left, scratch) = work.activations(len);
                network.forward_saving(input, &mut left, scratch, values);
                let mut loss = 0.0;
                for (q, y) in values.iter_mut().zip(targets) {
                    let error = *q - y;
                    loss += scale * error * error;
                    *q = 2.0 * scale * error;
                }
                let (mut left, scratch) = work.activations(len);
                network.backward(values, &mut left.slope, scratch);
                let input = concatenate(observations, actions, (observation_dim, action_dim));
                for layer in layers {
                    let number = layer.layer;
                    let x = if number == 0 { &input } else { &*left.x[number - 1] };
                    let gradient = left.slope.get(number).map_or(&*values, |slope| &**slope);
                    layer_gradient(layer, x, gradient);
                }
                loss
            })
        })
    }
}

impl Operation for SquaredError {
    const NAME: &'static str = "squared-error";

    fn forward(&self, given: Arguments<'_>) -> Result<(Vec<f32>, Shape)> {
        let EnsembleShape { members, observation_dim, action_dim, .. } = self.networks.shape;
        if [given.states, self.targets.len()] != [given.rows; 2] {
            candle_core::bail!("{} actions need as many observations and targets", given.rows);
        }
        let mut of_tiles = self.of_tiles.lock();
        of_tiles.resize(given.rows.div_ceil(TILE) * given.weights.len(), 0.0);
        let of_members = |(i, gradient)| {
            let mut of_members: Vec<Vec<_>> = (0..members).map(|_| Vec::new()).collect();
            self.networks.layers.split_mut(gradient).into_iter().for_each(|layer| of_members[layer.member].push(layer));
            of_members.into_iter().enumerate().map(move |(k, layers)| (i, k, layers))
        };
        let tiles: Vec<_> = of_tiles.chunks_exact_mut(given.weights.len()).enumerate().flat_map(of_members).collect();
        let scale = 1.0 / (members * given.rows) as f32;
        let tile = |(i, k, layers)| {
            let mine = |matrix, width| rows_of(matrix, i * TILE, TILE, width);
            let rows =
                (mine(given.observations, observation_dim), mine(given.actions, action_dim), mine(&self.targets, 1));
            self.tile(self.networks.member(given.weights, k), rows, scale, layers)
        };
        let losses: Vec<f32> = tiles.into_par_iter().map(tile).collect();
        Ok((vec![losses.iter().sum()], ().into()))
    }

    fn backward(&self, _: Arguments<'_>, gradient: &[f32]) -> Result<()> {
        self.kept.write(|sum| weighted_sum(&self.of_tiles.lock(), gradient[0], sum))
    }
}

/// ∇_a Q_k(s, a): `K × rows × a`, worked out tile by tile on the forward pass, while its activations are at hand.
pub(crate) struct ActionGradients {
    pub networks: Arc<Networks>,
}

impl Operation for ActionGradients {
    const NAME: &'static str = "action-gradients";

    fn forward(&self, given: Arguments<'_>) -> Result<(Vec<f32>, Shape)> {
        let EnsembleShape { members, observation_dim, action_dim, hidden, .. } = self.networks.shape;
        let (mut out, repeat) = (vec![0.0; members * given.rows * action_dim], given.rows / given.states);
        self.networks.for_each_tile(given, &mut out, |_, network, states, actions, out| {
            let rows = out.len() / action_dim;
            with_workspace(|work| {
                work.with_base(states.len() / observation_dim * hidden, rows, |base, values, work| {
                    network.state_part(states, base);
                    let input = Input { base, repeat, shift: network.bias(0), actions };
                    let (mut left, scratch) = work.activations(rows * hidden);
                    network.forward_saving(input, &mut left, scratch, values);
                    values.fill(1.0);
                    let (mut left, scratch) = work.activations(rows * hidden);
                    network.backward(values, &mut left.slope, scratch);
                    network.action_gradient(left.slope[0], out);
                });
            });
        });
        Ok((out, (members, given.rows, action_dim).into()))
    }
}
