//! The network that all others are made of: three hidden Mish layers over [s, a, …] and a narrow linear output; forward
//! and backward for one tile of rows.
//!
//! The first layer is taken apart: the state's part is computed once per state, whatever number of actions is tried in
//! it, and the action's few columns are fused with the activation.

use crate::layers::Layers;
use quad_kernels::Buffer;
use quad_kernels::activation::{bias_mish, bias_mish_slope, multiply};
use quad_kernels::narrow::{FirstLayer, dots, first_layer, first_layer_slope, scale_by_combination};
use quad_kernels::product::{Rounded, product, product_transposed};
use std::cell::RefCell;

/// Rows that one task works on: weights and activations of a tile stay in a core's own cache.
pub(crate) const TILE: usize = 128;
/// The same within a task whose products are rounded: these are so fast that activations must be in the nearest cache.
const BLOCK: usize = 32;

/// One member of the networks in a vector of weights.
#[derive(Clone, Copy)]
pub(crate) struct Network<'a> {
    weights: &'a [f32],
    layers: &'a Layers,
    member: usize,
    observation_dim: usize,
    action_dim: usize,
    /// The two kernels between hidden layers with their numbers rounded, if they are to be used.
    rounded: Option<&'a [Rounded; 2]>,
}

/// What a tile of rows is fed: `repeat` consecutive rows share a row of `base`.
#[derive(Clone, Copy)]
pub(crate) struct Input<'a> {
    /// State part of the first pre-activation, from [`Network::state_part`].
    pub base: &'a [f32],
    pub repeat: usize,
    /// Added to each row of the first pre-activation (bias and all else that the tile shares).
    pub shift: &'a [f32],
    /// `rows × action_dim`.
    pub actions: &'a [f32],
}

/// Activations of a tile's hidden layers, and their slopes; on the backward pass the gradients before the activations.
pub(crate) struct Activations<'a> {
    pub x: [&'a mut [f32]; 3],
    pub slope: [&'a mut [f32]; 3],
}

/// Buffers of one thread, grown to the largest tile it met.
#[derive(Default)]
pub(crate) struct Workspace {
    x: [Buffer; 3],
    slope: [Buffer; 3],
    temporary: Buffer,
    /// The output layer's kernel, transposed.
    output: Buffer,
    /// State part of the first layer.
    base: Buffer,
    /// Network output or its gradient.
    out: Buffer,
}

thread_local! {
    static WORKSPACE: RefCell<Workspace> = RefCell::default();
}

/// Lends the thread's workspace. Not re-entrant: a task that holds it must not start others.
pub(crate) fn with_workspace<R>(work: impl FnOnce(&mut Workspace) -> R) -> R {
    WORKSPACE.with_borrow_mut(work)
}

impl Workspace {
    /// Lends the buffer of the state part, `len` numbers, and that of the output, `out` numbers, beside the others.
    pub fn with_base<R>(
        &mut self,
        len: usize,
        out: usize,
        work: impl FnOnce(&mut [f32], &mut [f32], &mut Self) -> R,
    ) -> R {
        let (mut base, mut outputs) = (std::mem::take(&mut self.base), std::mem::take(&mut self.out));
        let result = work(base.sized(len), outputs.sized(out), self);
        (self.base, self.out) = (base, outputs);
        result
    }

    /// The activations of `len` numbers a layer, for a tile whose gradients are taken at once.
    pub fn activations(&mut self, len: usize) -> (Activations<'_>, Scratch<'_>) {
        let Self { x, slope, temporary, output, .. } = self;
        let activations =
            Activations { x: x.each_mut().map(|x| x.sized(len)), slope: slope.each_mut().map(|s| s.sized(len)) };
        (activations, Scratch { temporary, output })
    }

    pub fn scratch(&mut self) -> Scratch<'_> {
        Scratch { temporary: &mut self.temporary, output: &mut self.output }
    }
}

/// Buffers whose contents are not needed afterwards.
pub(crate) struct Scratch<'a> {
    temporary: &'a mut Buffer,
    output: &'a mut Buffer,
}

impl<'a> Network<'a> {
    pub fn new(weights: &'a [f32], layers: &'a Layers, member: usize, dims: (usize, usize)) -> Self {
        Self { weights, layers, member, observation_dim: dims.0, action_dim: dims.1, rounded: None }
    }

    /// The same, but forward passes use these kernels, which are of the same weights.
    pub fn with_rounded(self, rounded: Option<&'a [Rounded; 2]>) -> Self {
        Self { rounded, ..self }
    }

    /// Width of the hidden layers.
    pub fn hidden(&self) -> usize {
        self.layers.shape(0).1
    }

    /// Width of the output.
    fn outputs(&self) -> usize {
        self.layers.shape(3).1
    }

    pub fn kernel(&self, layer: usize) -> &'a [f32] {
        self.layers.kernel(self.weights, layer, self.member)
    }

    pub fn bias(&self, layer: usize) -> &'a [f32] {
        self.layers.bias(self.weights, layer, self.member)
    }

    /// Rows of the first kernel that multiply the action.
    fn action_kernel(&self) -> &'a [f32] {
        let from = self.observation_dim * self.hidden();
        &self.kernel(0)[from..from + self.action_dim * self.hidden()]
    }

    /// Rows of the first kernel behind those of state and action.
    pub fn tail_kernel(&self) -> &'a [f32] {
        &self.kernel(0)[(self.observation_dim + self.action_dim) * self.hidden()..]
    }

    /// `out[states × hidden] = observations · kernel_s`, without the bias.
    pub fn state_part(&self, observations: &[f32], out: &mut [f32]) {
        let kernel = &self.kernel(0)[..self.observation_dim * self.hidden()];
        product(observations, kernel, out, self.observation_dim, self.hidden());
    }

    fn first(&self, input: Input<'a>) -> FirstLayer<'a> {
        let Input { base, repeat, shift, actions } = input;
        FirstLayer { base, repeat, shift, actions, kernel: self.action_kernel() }
    }

    /// The output layer's kernel as `outputs × hidden`.
    fn output_rows<'b>(&self, transposed: &'b mut Buffer) -> &'b [f32]
    where
        'a: 'b,
    {
        let (kernel, hidden, outputs) = (self.kernel(3), self.hidden(), self.outputs());
        if outputs == 1 {
            return kernel;
        }
        let rows = transposed.sized(kernel.len());
        for h in 0..hidden {
            for j in 0..outputs {
                rows[j * hidden + h] = kernel[h * outputs + j];
            }
        }
        rows
    }

    /// The two kernels between hidden layers, rounded; `None` where [`Self::forward`] is as fast without.
    pub fn round(&self) -> Option<[Rounded; 2]> {
        let round = |layer| Rounded::new(self.kernel(layer), self.hidden(), self.hidden());
        Some([round(1)?, round(2)?])
    }

    /// `out[rows × outputs]` of a tile.
    pub fn forward(&self, input: Input<'_>, work: &mut Workspace, out: &mut [f32]) {
        let (h, outputs) = (self.hidden(), self.outputs());
        let [x, y, _] = &mut work.x;
        let output = self.output_rows(&mut work.output);
        let hidden = |layer: usize, x: &[f32], out: &mut [f32]| {
            match self.rounded {
                Some(kernels) => kernels[layer - 1].product(x, out),
                None => product(x, self.kernel(layer), out, h, h),
            }
            bias_mish(out, self.bias(layer));
        };
        let block = if self.rounded.is_some() { BLOCK } else { TILE };
        let states = (block / input.repeat).max(1);
        let rows = states * input.repeat;
        for (i, (base, out)) in input.base.chunks(states * h).zip(out.chunks_mut(rows * outputs)).enumerate() {
            let count = out.len() / outputs;
            let actions = &input.actions[i * rows * self.action_dim..][..count * self.action_dim];
            let (x, y) = (x.sized(count * h), y.sized(count * h));
            let network: Network<'_> = *self;
            first_layer(&network.first(Input { base, actions, ..input }), x);
            hidden(1, x, y);
            hidden(2, y, x);
            dots(x, output, self.bias(3), out, h);
        }
    }

    /// `forward` that leaves activations and slopes behind for `backward`.
    pub fn forward_saving(&self, input: Input<'_>, left: &mut Activations<'_>, scratch: Scratch<'_>, out: &mut [f32]) {
        let h = self.hidden();
        let ([x1, x2, x3], [s1, s2, s3]) = (&mut left.x, &mut left.slope);
        let network: Network<'_> = *self;
        first_layer_slope(&network.first(input), x1, s1);
        product(x1, self.kernel(1), x2, h, h);
        bias_mish_slope(x2, self.bias(1), s2);
        product(x2, self.kernel(2), x3, h, h);
        bias_mish_slope(x3, self.bias(2), s3);
        dots(x3, self.output_rows(scratch.output), self.bias(3), out, h);
    }

    /// Turns the slopes of a tile into the gradients δ before each activation, given that of the output.
    pub fn backward(&self, output_gradient: &[f32], slope: &mut [&mut [f32]; 3], scratch: Scratch<'_>) {
        let h = self.hidden();
        let [s1, s2, s3] = slope;
        let temporary = scratch.temporary.sized(s1.len());
        scale_by_combination(s3, output_gradient, self.output_rows(scratch.output), h);
        product_transposed(s3, self.kernel(2), temporary, h, h);
        multiply(s2, temporary);
        product_transposed(s2, self.kernel(1), temporary, h, h);
        multiply(s1, temporary);
    }

    /// After `backward`: the action's gradient, `rows × action_dim`, from that before the first activation.
    pub fn action_gradient(&self, delta: &[f32], out: &mut [f32]) {
        let zero = vec![0.0; self.action_dim];
        dots(delta, self.action_kernel(), &zero, out, self.hidden());
    }
}

/// Rows `from .. from + count` (or fewer, at the end) of a matrix with `width` columns.
pub(crate) fn rows_of(matrix: &[f32], from: usize, count: usize, width: usize) -> &[f32] {
    let end = ((from + count) * width).min(matrix.len());
    &matrix[from * width..end]
}
