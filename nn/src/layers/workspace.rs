//! Buffers that a thread keeps from one tile of rows to the next.

use crate::layers::flat::Layers;
use quad_kernels::Buffer;
use quad_kernels::norm::kept;
use std::cell::RefCell;

/// Activations of a tile's hidden layers, and their slopes; on the backward pass the gradients
/// before the activations.
pub(crate) struct Activations<'a> {
    pub x: Vec<&'a mut [f32]>,
    pub slope: Vec<&'a mut [f32]>,
    /// What norms keep ([`quad_kernels::norm`]); empty without a norm.
    pub norm: Vec<&'a mut [f32]>,
}

/// Buffers of one thread, grown to the largest tile it met.
#[derive(Default)]
pub(crate) struct Workspace {
    pub pair: [Buffer; 2],
    /// The output layer's kernel, transposed.
    pub output: Buffer,
    /// State part of the first layer.
    base: Buffer,
    /// Network output or its gradient.
    out: Buffer,
    x: Vec<Buffer>,
    slope: Vec<Buffer>,
    norm: Vec<Buffer>,
    /// What a norm keeps when no gradient is taken.
    pub not_kept: Buffer,
}

thread_local! {
    static WORKSPACE: RefCell<Workspace> = RefCell::default();
}

/// Lends the thread's workspace. Not re-entrant: a task that holds it must not start others.
pub(crate) fn with_workspace<R>(work: impl FnOnce(&mut Workspace) -> R) -> R {
    WORKSPACE.with_borrow_mut(work)
}

impl Workspace {
    /// Lends the buffer of the state part, `len` numbers, and that of the output, `out` numbers,
    /// beside the others.
    pub fn with_base<R>(
        &mut self,
        len: usize,
        out: usize,
        work: impl FnOnce(&mut [f32], &mut [f32], &mut Self) -> R,
    ) -> R {
        let (mut base, mut outputs) =
            (std::mem::take(&mut self.base), std::mem::take(&mut self.out));
        let result = work(base.sized(len), outputs.sized(out), self);
        (self.base, self.out) = (base, outputs);
        result
    }

    /// Lends room for the activations of `rows` rows, for a tile whose gradients are taken at once.
    pub fn with_activations<R>(
        &mut self,
        rows: usize,
        layers: &Layers,
        work: impl FnOnce(&mut Activations<'_>, &mut Self) -> R,
    ) -> R {
        let mut all = [&mut self.x, &mut self.slope, &mut self.norm].map(std::mem::take);
        let widths = layers.hidden();
        all.iter_mut().for_each(|buffers| {
            buffers.resize_with(widths.len().max(buffers.len()), Buffer::default)
        });
        let [x, slope, norm] = &mut all;
        let normed = if layers.norm { widths } else { &[] };
        let x =
            x.iter_mut().zip(widths).map(|(buffer, width)| buffer.sized(rows * width)).collect();
        let slope = slope
            .iter_mut()
            .zip(widths)
            .map(|(buffer, width)| buffer.sized(rows * width))
            .collect();
        let norm = norm
            .iter_mut()
            .zip(normed)
            .map(|(buffer, width)| buffer.sized(kept(rows, *width)))
            .collect();
        let result = work(&mut Activations { x, slope, norm }, self);
        [self.x, self.slope, self.norm] = all;
        result
    }
}
