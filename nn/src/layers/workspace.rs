//! Buffers of a thread, reused from tile to tile.

use crate::layers::flat::Layers;
use quad_kernels::Buffer;
use quad_kernels::norm::saved_len;
use std::cell::RefCell;

/// Activations and slopes of a tile's hidden layers; the backward pass replaces the slopes by the
/// gradients before the activations.
#[derive(Default)]
pub(crate) struct Activations<'a> {
    pub x: Vec<&'a mut [f32]>,
    pub slope: Vec<&'a mut [f32]>,
    /// Saved by norms ([`quad_kernels::norm`]); empty without a norm.
    pub norm: Vec<&'a mut [f32]>,
}

/// Buffers of one thread, as large as its largest tile.
#[derive(Default)]
pub(crate) struct Workspace {
    pub pair: [Buffer; 2],
    /// The output layer's kernel, transposed.
    pub output: Buffer,
    /// State part of the first layer.
    base: Buffer,
    out: Buffer,
    x: Vec<Buffer>,
    slope: Vec<Buffer>,
    norm: Vec<Buffer>,
    /// Saved by a norm when no gradient is taken.
    pub norm_scratch: Buffer,
}

thread_local! {
    static WORKSPACE: RefCell<Workspace> = RefCell::default();
}

/// Runs `work` with the thread's workspace. Not re-entrant: `work` must not start other tasks.
pub(crate) fn with_workspace<R>(work: impl FnOnce(&mut Workspace) -> R) -> R {
    WORKSPACE.with_borrow_mut(work)
}

impl Workspace {
    /// Runs `work` with the buffers of the state part, `len` numbers, and of the output, `out`
    /// numbers.
    pub fn with_base<R>(
        &mut self,
        len: usize,
        out: usize,
        work: impl FnOnce(&mut [f32], &mut [f32], &mut Self) -> R,
    ) -> R {
        let [mut base, mut outputs] = [&mut self.base, &mut self.out].map(std::mem::take);
        let result = work(base.sized(len), outputs.sized(out), self);
        (self.base, self.out) = (base, outputs);
        result
    }

    /// Runs `work` with room for the activations of `rows` rows.
    pub fn with_activations<R>(
        &mut self,
        rows: usize,
        layers: &Layers,
        work: impl FnOnce(&mut Activations<'_>, &mut Self) -> R,
    ) -> R {
        /// One buffer for each width, `len(width)` numbers long.
        fn sized<'a>(
            buffers: &'a mut Vec<Buffer>,
            widths: &[usize],
            len: impl Fn(usize) -> usize,
        ) -> Vec<&'a mut [f32]> {
            buffers.resize_with(widths.len().max(buffers.len()), Buffer::default);
            let each = buffers.iter_mut().zip(widths);
            each.map(|(buffer, width)| buffer.sized(len(*width))).collect()
        }
        let mut taken = [&mut self.x, &mut self.slope, &mut self.norm].map(std::mem::take);
        let [x, slope, norm] = &mut taken;
        let widths = &layers.config.hidden[..];
        let normed = if layers.config.norm { widths } else { &[] };
        let x = sized(x, widths, |width| rows * width);
        let slope = sized(slope, widths, |width| rows * width);
        let norm = sized(norm, normed, |width| saved_len(rows, width));
        let result = work(&mut Activations { x, slope, norm }, self);
        [self.x, self.slope, self.norm] = taken;
        result
    }
}
