//! What a forward pass leaves behind for its backward pass, and the weights' gradient made of it.

use crate::layers::LayerMut;
use crate::network::{Activations, TILE};
use quad_kernels::Buffer;
use quad_kernels::activation::column_sums;
use quad_kernels::product::outer;
use rayon::prelude::*;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Activations of all hidden layers of all members, and their slopes, each `members × rows × hidden`; on the backward pass the
/// gradients before the activations take the slopes' place.
#[derive(Default)]
pub(crate) struct SavedActivations {
    x: [Buffer; 3],
    slope: [Buffer; 3],
    rows: usize,
    hidden: usize,
    members: usize,
}

/// A tile of some rows of one member.
pub(crate) struct Tile<'a> {
    pub member: usize,
    /// Place among the member's tiles.
    pub index: usize,
    pub activations: Activations<'a>,
    /// `rows × outputs`.
    pub out: &'a mut [f32],
}

impl SavedActivations {
    /// Makes room.
    pub fn resize(&mut self, members: usize, rows: usize, hidden: usize) {
        (self.members, self.rows, self.hidden) = (members, rows, hidden);
        for buffer in self.x.iter_mut().chain(&mut self.slope) {
            buffer.sized(members * rows * hidden);
        }
    }

    /// Cuts everything into tiles, beside `out`, which is `members × rows × outputs`.
    pub fn tiles<'a>(&'a mut self, out: &'a mut [f32]) -> Vec<Tile<'a>> {
        let len = self.members * self.rows * self.hidden;
        let (rows, hidden) = (self.rows, self.hidden);
        let outputs = out.len() / (self.members * rows);
        let cut = |all: &'a mut [f32], width: usize| {
            all.chunks_mut(rows * width).flat_map(move |member| member.chunks_mut(TILE * width))
        };
        let [x1, x2, x3] = self.x.each_mut().map(|x| cut(x.sized(len), hidden));
        let [s1, s2, s3] = self.slope.each_mut().map(|s| cut(s.sized(len), hidden));
        let tiles = x1.zip(x2).zip(x3).zip(s1.zip(s2).zip(s3)).zip(cut(out, outputs));
        let each_member = rows.div_ceil(TILE);
        tiles
            .enumerate()
            .map(|(i, ((((x1, x2), x3), ((s1, s2), s3)), out))| Tile {
                member: i / each_member,
                index: i % each_member,
                activations: Activations { x: [x1, x2, x3], slope: [s1, s2, s3] },
                out,
            })
            .collect()
    }

    fn of_member<'a>(&self, buffer: &'a Buffer, member: usize) -> &'a [f32] {
        let len = self.rows * self.hidden;
        &buffer.first(self.members * len)[member * len..][..len]
    }

    /// The gradient before a member's first activation, `rows × hidden`, after the backward pass.
    pub fn first_delta(&self, member: usize) -> &[f32] {
        self.of_member(&self.slope[0], member)
    }

    /// After the backward pass: the gradients of these layers. `input` is `rows × width`; the first kernel's rows behind the
    /// first `width` are left to the caller. `output_gradient` is `members × rows × outputs`.
    pub fn weight_gradients(&self, layers: Vec<LayerMut<'_>>, input: &[f32], output_gradient: &[f32]) {
        layers.into_par_iter().for_each(|layer| {
            let (number, member) = (layer.layer, layer.member);
            let x = if number == 0 { input } else { self.of_member(&self.x[number - 1], member) };
            let gradient = match self.slope.get(number) {
                Some(delta) => self.of_member(delta, member),
                None => &output_gradient[member * self.rows * layer.bias.len()..][..self.rows * layer.bias.len()],
            };
            layer_gradient(layer, x, gradient);
        });
    }
}

/// A layer's gradient, from its input `rows × width` and the gradient before its activation, `rows × columns`. Rows of the
/// kernel behind the first `width` are left to the caller.
pub(crate) fn layer_gradient(layer: LayerMut<'_>, x: &[f32], gradient: &[f32]) {
    let LayerMut { kernel, bias, .. } = layer;
    let columns = bias.len();
    let width = x.len() / (gradient.len() / columns);
    outer(x, gradient, &mut kernel[..width * columns], width, columns);
    column_sums(gradient, bias);
}

/// Memory that is used again: fresh memory of such sizes would cost as much as the arithmetic.
pub(crate) struct Pool<T>(Arc<Mutex<Vec<T>>>);

impl<T> Clone for Pool<T> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<T> Default for Pool<T> {
    fn default() -> Self {
        Self(Arc::default())
    }
}

impl<T: Default> Pool<T> {
    /// One that is lent until it is dropped.
    pub fn lend(&self) -> Lent<T> {
        let lent = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default();
        Lent { lent: Mutex::new(lent), home: self.clone() }
    }
}

/// What a pool has lent.
pub(crate) struct Lent<T: Default> {
    lent: Mutex<T>,
    home: Pool<T>,
}

impl<T: Default> Lent<T> {
    /// Access to it, of one at a time.
    pub fn lock(&self) -> MutexGuard<'_, T> {
        self.lent.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T: Default> Drop for Lent<T> {
    fn drop(&mut self) {
        let lent = std::mem::take(self.lent.get_mut().unwrap_or_else(PoisonError::into_inner));
        self.home.0.lock().unwrap_or_else(PoisonError::into_inner).push(lent);
    }
}

/// `[s, a]` row by row.
pub(crate) fn concatenate(observations: &[f32], actions: &[f32], dims: (usize, usize)) -> Vec<f32> {
    let rows = observations.len() / dims.0;
    let mut out = Vec::with_capacity(observations.len() + actions.len());
    for row in 0..rows {
        out.extend_from_slice(&observations[row * dims.0..][..dims.0]);
        out.extend_from_slice(&actions[row * dims.1..][..dims.1]);
    }
    out
}
