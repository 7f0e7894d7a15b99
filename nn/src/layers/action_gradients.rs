//! ∇_a Q_k(s, a): a custom operation of (weights, observations, actions) on the CPU. It goes
//! forward and back through one tile of rows after the other, while the tile's activations are in a
//! core's cache; tiles run in parallel.

use crate::layers::flat::TILE;
use crate::layers::mlp::Mlp;
use crate::layers::operation::{Arguments, Operation};
use crate::layers::workspace::with_workspace;
use candle_core::{Result, Shape};
use rayon::prelude::*;

/// The operation: `K × rows × a`, of networks over [s, a] with one output.
pub(crate) struct ActionGradients {
    pub networks: Mlp,
}

impl Operation for ActionGradients {
    const NAME: &'static str = "action-gradients";

    fn forward(&self, given: Arguments<'_>) -> Result<(Vec<f32>, Shape)> {
        let Arguments { weights, observations, actions, states, rows } = given;
        let (o, a, repeat) = (observations.len() / states, actions.len() / rows, rows / states);
        let (layers, members) = (&self.networks.layers, self.networks.layers.members);
        let mut out = vec![0.0; members * rows * a];
        out.par_chunks_mut(rows * a).enumerate().for_each(|(member, out)| {
            let network = self.networks.network(weights, member);
            out.par_chunks_mut(TILE * a).enumerate().for_each(|(i, out)| {
                let count = out.len() / a;
                let mut x = Vec::with_capacity(count * (o + a));
                for row in i * TILE..i * TILE + count {
                    x.extend_from_slice(&observations[row / repeat * o..][..o]);
                    x.extend_from_slice(&actions[row * a..][..a]);
                }
                with_workspace(|work| {
                    work.with_activations(count, layers, |left, work| {
                        let mut values = vec![0.0; count];
                        network.forward_saving(&x, left, work, &mut values);
                        values.fill(1.0);
                        network.backward(&values, left, work);
                        network.input_gradient(left.slope[0], (o, a), out);
                    });
                });
            });
        });
        Ok((out, (members, rows, a).into()))
    }
}
