//! The network that noise predictor and critics share: three hidden Mish layers over [s, a, …] and a narrow linear
//! output, forward and backward for one tile of rows.
//!
//! The first layer is taken apart: the state's part is computed once per state, whatever number of actions is tried in
//! it, and the action's few columns are fused with the activation.

use crate::Precision;
use crate::elementwise::{
    FirstLayer, bias_mish, bias_mish_slope, column_sums, dots, first_layer, first_layer_slope, multiply,
    scale_by_combination,
};
use crate::matmul::{outer, product, product_bf16, product_transposed};
use crate::mlp::Mlp;
use std::cell::RefCell;

/// Rows that one task works on: weights and activations of a tile stay in a core's own cache.
pub(crate) const TILE: usize = 128;

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
    x: [Vec<f32>; 3],
    /// Their slopes; on the way back the gradients before the activations.
    pub slope: [Vec<f32>; 3],
    temporary: Vec<f32>,
    /// The output layer's kernel, transposed.
    output: Vec<f32>,
    /// State part of the first layer.
    pub base: Vec<f32>,
    /// Network input, where a kernel's gradient needs it.
    pub input: Vec<f32>,
    /// Network output or its gradient.
    pub out: Vec<f32>,
}

thread_local! {
    static WORKSPACE: RefCell<Workspace> = RefCell::default();
}

/// Lends the thread's workspace. Not re-entrant: a task that holds it must not start others.
pub(crate) fn with_workspace<R>(work: impl FnOnce(&mut Workspace) -> R) -> R {
    WORKSPACE.with_borrow_mut(work)
}

/// The first `len` elements, grown where needed; what they hold is left over from earlier use.
pub(crate) fn sized(buffer: &mut Vec<f32>, len: usize) -> &mut [f32] {
    if buffer.len() < len {
        buffer.resize(len, 0.0);
    }
    &mut buffer[..len]
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
    fn output_rows<'a>(&self, parameters: &'a [f32], transposed: &'a mut Vec<f32>) -> &'a [f32] {
        let kernel = self.mlp.kernel(parameters, 3);
        let (hidden, outputs) = self.mlp.shape(3);
        if outputs == 1 {
            return kernel;
        }
        let rows = sized(transposed, kernel.len());
        for h in 0..hidden {
            for j in 0..outputs {
                rows[j * hidden + h] = kernel[h * outputs + j];
            }
        }
        rows
    }

    /// `out[rows × outputs]` of a tile.
    pub fn forward(
        &self,
        parameters: &[f32],
        input: Input<'_>,
        precision: Precision,
        work: &mut Workspace,
        out: &mut [f32],
    ) {
        let product = match precision {
            Precision::F32 => product,
            Precision::Bf16 => product_bf16,
        };
        let (h, len) = (self.hidden, input.actions.len() / self.action_dim * self.hidden);
        let [x, y, _] = &mut work.x;
        let (x, y) = (sized(x, len), sized(y, len));
        first_layer(&self.first(parameters, input), x);
        product(x, self.mlp.kernel(parameters, 1), y, h, h);
        bias_mish(y, self.mlp.bias(parameters, 1));
        product(y, self.mlp.kernel(parameters, 2), x, h, h);
        bias_mish(x, self.mlp.bias(parameters, 2));
        dots(x, self.output_rows(parameters, &mut work.output), self.mlp.bias(parameters, 3), out, h);
    }

    /// `forward` that leaves activations and slopes in the workspace for `backward`.
    pub fn forward_recorded(&self, parameters: &[f32], input: Input<'_>, work: &mut Workspace, out: &mut [f32]) {
        let (h, len) = (self.hidden, input.actions.len() / self.action_dim * self.hidden);
        let [x1, x2, x3] = work.x.each_mut().map(|x| sized(x, len));
        let [s1, s2, s3] = work.slope.each_mut().map(|s| sized(s, len));
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
        let [s1, s2, s3] = work.slope.each_mut().map(|s| sized(s, len));
        let temporary = sized(&mut work.temporary, len);
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
        let [d1, d2, d3] = work.slope.each_ref().map(|s| &s[..len]);
        let [x1, x2, x3] = work.x.each_ref().map(|x| &x[..len]);
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
        dots(&work.slope[0][..len], self.action_kernel(parameters), &zero, out, self.hidden);
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
