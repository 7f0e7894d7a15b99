//! The network that noise predictor and critics share: three hidden Mish layers over [s, a, …] and a narrow linear
//! output, forward and backward for one tile of rows.
//!
//! The first layer is taken apart: the state's part is computed once per state, whatever number of actions is tried in
//! it, and the action's few columns are fused with the activation.

use crate::buffer::Buffer;
use crate::elementwise::{
    FirstLayer, bias_mish, bias_mish_slope, column_sums, dots, first_layer, first_layer_slope, multiply,
    scale_by_combination,
};
use crate::matmul::{Rounded, outer, product, product_transposed};
use crate::mlp::Mlp;
use std::cell::RefCell;

/// Rows that one task works on: weights and activations of a tile stay in a core's own cache.
pub(crate) const TILE: usize = 128;
/// The same within a task whose products are rounded: these are so fast that activations must be in the nearest cache.
const BLOCK: usize = 32;

/// Shapes of one network.
#[derive(Clone, Debug)]
pub(crate) struct Network {
    pub mlp: Mlp,
    pub observation_dim: usize,
    pub action_dim: usize,
    pub hidden: usize,
}

/// What a tile of rows is fed: `repeat` consecutive rows of `actions` share a row of `base`.
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

/// Buffers of one thread, grown to the largest tile it met.
#[derive(Default)]
pub(crate) struct Workspace {
    /// Activations of the hidden layers.
    x: [Buffer; 3],
    /// Their slopes; on the way back the gradients before the activations.
    pub slope: [Buffer; 3],
    temporary: Buffer,
    /// The output layer's kernel, transposed.
    output: Buffer,
    /// State part of the first layer.
    pub base: Buffer,
    /// Network input, where a kernel's gradient needs it.
    pub input: Vec<f32>,
    /// Network output or its gradient.
    pub out: Buffer,
}

thread_local! {
    static WORKSPACE: RefCell<Workspace> = RefCell::default();
}

/// Lends the thread's workspace. Not re-entrant: a task that holds it must not start others.
pub(crate) fn with_workspace<R>(work: impl FnOnce(&mut Workspace) -> R) -> R {
    WORKSPACE.with_borrow_mut(work)
}

impl Network {
    /// Rows of the first kernel that multiply the action.
    fn action_kernel<'a>(&self, parameters: &'a [f32]) -> &'a [f32] {
        let from = self.observation_dim * self.hidden;
        &self.mlp.kernel(parameters, 0)[from..from + self.action_dim * self.hidden]
    }

    /// Rows of the first kernel behind those of state and action.
    pub fn tail_kernel<'a>(&self, parameters: &'a [f32]) -> &'a [f32] {
        &self.mlp.kernel(parameters, 0)[(self.observation_dim + self.action_dim) * self.hidden..]
    }

    /// `out[states × hidden] = observations · kernel_s`, without the bias.
    pub fn state_part(&self, parameters: &[f32], observations: &[f32], out: &mut [f32]) {
        let kernel = &self.mlp.kernel(parameters, 0)[..self.observation_dim * self.hidden];
        product(observations, kernel, out, self.observation_dim, self.hidden);
    }

    fn first<'a>(&self, parameters: &'a [f32], input: Input<'a>) -> FirstLayer<'a> {
        FirstLayer {
            base: input.base,
            repeat: input.repeat,
            shift: input.shift,
            actions: input.actions,
            kernel: self.action_kernel(parameters),
        }
    }

    /// The output layer's kernel as `outputs × hidden`.
    fn output_rows<'a>(&self, parameters: &'a [f32], transposed: &'a mut Buffer) -> &'a [f32] {
        let kernel = self.mlp.kernel(parameters, 3);
        let (hidden, outputs) = self.mlp.shape(3);
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
    pub fn round(&self, parameters: &[f32]) -> Option<[Rounded; 2]> {
        let round = |layer| Rounded::new(self.mlp.kernel(parameters, layer), self.hidden, self.hidden);
        Some([round(1)?, round(2)?])
    }

    /// `out[rows × outputs]` of a tile, by the rounded kernels if there are any.
    pub fn forward(
        &self,
        parameters: &[f32],
        rounded: Option<&[Rounded; 2]>,
        input: Input<'_>,
        work: &mut Workspace,
        out: &mut [f32],
    ) {
        let (h, a, outputs) = (self.hidden, self.action_dim, self.mlp.shape(3).1);
        let [x, y, _] = &mut work.x;
        let output = self.output_rows(parameters, &mut work.output);
        let hidden = |layer: usize, x: &[f32], out: &mut [f32]| {
            match rounded {
                Some(kernels) => kernels[layer - 1].product(x, out),
                None => product(x, self.mlp.kernel(parameters, layer), out, h, h),
            }
            bias_mish(out, self.mlp.bias(parameters, layer));
        };
        let block = if rounded.is_some() { BLOCK } else { TILE };
        let states = (block / input.repeat).max(1);
        let rows = states * input.repeat;
        let blocks = input.base.chunks(states * h).zip(input.actions.chunks(rows * a));
        for ((base, actions), out) in blocks.zip(out.chunks_mut(rows * outputs)) {
            let len = actions.len() / a * h;
            let (x, y) = (x.sized(len), y.sized(len));
            first_layer(&self.first(parameters, Input { base, actions, ..input }), x);
            hidden(1, x, y);
            hidden(2, y, x);
            dots(x, output, self.mlp.bias(parameters, 3), out, h);
        }
    }

    /// `forward` that leaves activations and slopes in the workspace for `backward`.
    pub fn forward_recorded(&self, parameters: &[f32], input: Input<'_>, work: &mut Workspace, out: &mut [f32]) {
        let (h, len) = (self.hidden, input.actions.len() / self.action_dim * self.hidden);
        let [x1, x2, x3] = work.x.each_mut().map(|x| x.sized(len));
        let [s1, s2, s3] = work.slope.each_mut().map(|s| s.sized(len));
        first_layer_slope(&self.first(parameters, input), x1, s1);
        product(x1, self.mlp.kernel(parameters, 1), x2, h, h);
        bias_mish_slope(x2, self.mlp.bias(parameters, 1), s2);
        product(x2, self.mlp.kernel(parameters, 2), x3, h, h);
        bias_mish_slope(x3, self.mlp.bias(parameters, 2), s3);
        dots(x3, self.output_rows(parameters, &mut work.output), self.mlp.bias(parameters, 3), out, h);
    }

    /// Turns the recorded slopes into the gradients δ before each activation, given that of the output.
    pub fn backward(&self, parameters: &[f32], output_gradient: &[f32], work: &mut Workspace) {
        let h = self.hidden;
        let len = output_gradient.len() / self.mlp.shape(3).1 * h;
        let [s1, s2, s3] = work.slope.each_mut().map(|s| s.sized(len));
        let temporary = work.temporary.sized(len);
        scale_by_combination(s3, output_gradient, self.output_rows(parameters, &mut work.output), h);
        product_transposed(s3, self.mlp.kernel(parameters, 2), temporary, h, h);
        multiply(s2, temporary);
        product_transposed(s2, self.mlp.kernel(parameters, 1), temporary, h, h);
        multiply(s1, temporary);
    }

    /// After `backward`: the parameters' gradient. `input` is `rows × (observation_dim + action_dim)`; the first
    /// kernel's further rows are left to the caller.
    pub fn parameter_gradient(&self, input: &[f32], output_gradient: &[f32], work: &mut Workspace, out: &mut [f32]) {
        let (h, outputs) = self.mlp.shape(3);
        let len = output_gradient.len() / outputs * h;
        let [d1, d2, d3] = work.slope.each_ref().map(|s| s.first(len));
        let [x1, x2, x3] = work.x.each_ref().map(|x| x.first(len));
        let inputs = self.observation_dim + self.action_dim;
        for (layer, (x, width, gradient)) in
            [(input, inputs, d1), (x1, h, d2), (x2, h, d3), (x3, h, output_gradient)].into_iter().enumerate()
        {
            let (kernel, bias) = self.mlp.layer_mut(out, layer);
            let columns = bias.len();
            outer(x, gradient, &mut kernel[..width * columns], width, columns);
            column_sums(gradient, bias);
        }
    }

    /// After `backward`: the action's gradient, `rows × action_dim`.
    pub fn action_gradient(&self, parameters: &[f32], work: &Workspace, out: &mut [f32]) {
        let len = out.len() / self.action_dim * self.hidden;
        let zero = vec![0.0; self.action_dim];
        dots(work.slope[0].first(len), self.action_kernel(parameters), &zero, out, self.hidden);
    }
}

/// `[s, a]` row by row.
pub(crate) fn concatenate(observations: &[f32], actions: &[f32], dims: (usize, usize), out: &mut Vec<f32>) {
    out.clear();
    for (s, a) in observations.chunks_exact(dims.0).zip(actions.chunks_exact(dims.1)) {
        out.extend_from_slice(s);
        out.extend_from_slice(a);
    }
}
