//! Activations saved by a forward pass, and the weights' gradient computed from them.

use crate::layers::config::MlpConfig;
use crate::layers::flat::{LayerMut, Layers, TILE};
use crate::layers::workspace::Activations;
use quad_kernels::Buffer;
use quad_kernels::activation::column_sums;
use quad_kernels::norm::saved_len;
use quad_kernels::product::outer_rows;
use rayon::prelude::*;

/// Activations and slopes of the hidden layers, each `K × rows × width`; the backward pass replaces
/// the slopes by the gradients before the activations.
#[derive(Default)]
pub(crate) struct SavedActivations {
    x: Vec<Buffer>,
    slope: Vec<Buffer>,
    /// Saved by norms, for full tiles one after the other; empty without a norm.
    norm: Vec<Buffer>,
    widths: Vec<usize>,
    members: usize,
    rows: usize,
}

/// Some rows of one member.
pub(crate) struct Tile<'a> {
    pub member: usize,
    /// Index among the member's tiles.
    pub index: usize,
    pub activations: Activations<'a>,
    /// `rows × outputs`.
    pub out: &'a mut [f32],
}

impl SavedActivations {
    /// Prepares for a forward pass of this many rows.
    pub fn resize(&mut self, layers: &Layers, rows: usize) {
        let MlpConfig { hidden, norm, .. } = &layers.config;
        (self.widths, self.members, self.rows) = (hidden.clone(), layers.members, rows);
        let normed = if *norm { hidden.len() } else { 0 };
        self.x.resize_with(hidden.len(), Buffer::default);
        self.slope.resize_with(hidden.len(), Buffer::default);
        self.norm.resize_with(normed, Buffer::default);
    }

    /// Splits the activations and `out`, `K × rows × outputs`, into tiles.
    pub fn tiles<'a>(&'a mut self, out: &'a mut [f32]) -> Vec<Tile<'a>> {
        let (members, rows) = (self.members, self.rows);
        let cut = |numbers: &'a mut [f32]| {
            let width = numbers.len() / (members * rows);
            numbers.chunks_mut(rows * width).flat_map(move |member| member.chunks_mut(TILE * width))
        };
        let each_member = rows.div_ceil(TILE);
        let tile = |(i, out)| {
            let (member, index) = (i / each_member, i % each_member);
            let activations = Activations::default();
            Tile { member, index, activations, out }
        };
        let mut tiles: Vec<_> = cut(out).enumerate().map(tile).collect();
        for ((x, slope), width) in self.x.iter_mut().zip(&mut self.slope).zip(&self.widths) {
            let len = members * rows * width;
            let parts = cut(x.sized(len)).zip(cut(slope.sized(len)));
            for (tile, (x, slope)) in tiles.iter_mut().zip(parts) {
                tile.activations.x.push(x);
                tile.activations.slope.push(slope);
            }
        }
        for (layer, (norm, width)) in self.norm.iter_mut().zip(&self.widths).enumerate() {
            let full = saved_len(TILE, *width);
            let parts = norm.sized(members * each_member * full).chunks_exact_mut(full);
            for (tile, norm) in tiles.iter_mut().zip(parts) {
                let rows = tile.activations.x[layer].len() / width;
                tile.activations.norm.push(&mut norm[..saved_len(rows, *width)]);
            }
        }
        tiles
    }

    fn member_rows<'a>(&self, buffer: &'a Buffer, layer: usize, member: usize) -> &'a [f32] {
        let len = self.rows * self.widths[layer];
        &buffer.first(self.members * len)[member * len..][..len]
    }

    /// After the backward pass: the gradient before a member's first activation, `rows × width`.
    pub fn first_delta(&self, member: usize) -> &[f32] {
        self.member_rows(&self.slope[0], 0, member)
    }

    /// After the backward pass: writes the gradients of all layers. `input` is `rows × inputs`,
    /// `output_gradient` `K × rows × outputs`.
    pub fn weight_gradients(
        &self,
        layers: Vec<LayerMut<'_>>,
        input: &[f32],
        output_gradient: &[f32],
    ) {
        layers.into_par_iter().for_each(
            |LayerMut { layer, member, precision, kernel, bias, norm }| {
                let x = match layer {
                    0 => input,
                    _ => self.member_rows(&self.x[layer - 1], layer - 1, member),
                };
                let columns = bias.len();
                let gradient = match self.slope.get(layer) {
                    Some(delta) => self.member_rows(delta, layer, member),
                    None => &output_gradient[member * self.rows * columns..][..self.rows * columns],
                };
                let inputs = kernel.len() / columns;
                // A single network is split, for all threads to work.
                let rows = match self.members {
                    1 => inputs.min(TILE),
                    _ => inputs,
                };
                let parts = kernel.par_chunks_mut(rows * columns).enumerate();
                parts.for_each(|(i, kernel)| {
                    let rows = (i * rows, inputs);
                    outer_rows(precision, x, gradient, kernel, rows, columns);
                });
                column_sums(gradient, bias);
                for (i, out) in norm.into_iter().flatten().enumerate() {
                    self.sum_over_tiles(layer, member, i, out);
                }
            },
        );
    }

    /// The gradient of a norm's scales (0) or shifts (1): the sum of the tiles' parts.
    fn sum_over_tiles(&self, layer: usize, member: usize, which: usize, out: &mut [f32]) {
        let (tiles, width) = (self.rows.div_ceil(TILE), out.len());
        let full = saved_len(TILE, width);
        let saved = self.norm[layer].first(self.members * tiles * full);
        out.fill(0.0);
        for tile in saved[member * tiles * full..][..tiles * full].chunks_exact(full) {
            out.iter_mut().zip(&tile[which * width..]).for_each(|(sum, x)| *sum += x);
        }
    }
}
