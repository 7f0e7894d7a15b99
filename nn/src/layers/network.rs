//! One network on one tile of rows, forward and backward.
//!
//! Forward passes without gradients split the first layer: the state's part is computed once per
//! state for all its actions, and the action's few columns are fused with the activation.

use crate::layers::flat::{Layers, TILE};
use crate::layers::workspace::{Activations, Workspace};
use quad_kernels::Buffer;
use quad_kernels::activation::{activate, activate_with_slope, multiply};
use quad_kernels::narrow::{FirstLayer, dots, first_layer, scale_by_combination};
use quad_kernels::norm::{normalize, normalize_backward, saved_len, shift_rows};
use quad_kernels::product::{Packed, product, product_transposed};

/// Rows of a block in bfloat16, whose products are so fast that activations must be in the nearest
/// cache.
const BLOCK: usize = 32;
/// Largest number of inputs whose gradients are dot products, one by one.
const NARROW: usize = 16;

/// One member of an ensemble.
#[derive(Clone, Copy)]
pub(crate) struct Network<'a> {
    pub weights: &'a [f32],
    pub layers: &'a Layers,
    pub member: usize,
    /// Packed kernels between hidden layers.
    pub packed: Option<&'a [Packed]>,
}

impl<'a> Network<'a> {
    pub fn kernel(&self, layer: usize) -> &'a [f32] {
        self.layers.kernel(self.weights, layer, self.member)
    }

    pub fn bias(&self, layer: usize) -> &'a [f32] {
        self.layers.bias(self.weights, layer, self.member)
    }

    fn norm(&self, layer: usize) -> Option<[&'a [f32]; 2]> {
        self.layers.norm(self.weights, layer, self.member)
    }

    fn last(&self) -> usize {
        self.layers.count() - 1
    }

    /// Width of the first hidden layer.
    pub fn width(&self) -> usize {
        self.layers.shape(0).1
    }

    /// The first kernel's rows for inputs `from..from + count`.
    pub fn first_kernel(&self, from: usize, count: usize) -> &'a [f32] {
        let width = self.width();
        &self.kernel(0)[from * width..(from + count) * width]
    }

    /// `out[states × width] = x · kernel` for the first `inputs` inputs, without the bias.
    pub fn first_part(&self, x: &[f32], inputs: usize, out: &mut [f32]) {
        let (precision, kernel) = (self.layers.precision(0), self.first_kernel(0, inputs));
        product(precision, x, kernel, out, inputs, self.width());
    }

    /// `out = x · kernel` of a layer, without the bias.
    fn product(&self, layer: usize, x: &[f32], out: &mut [f32]) {
        let (inputs, outputs) = self.layers.shape(layer);
        let precision = self.layers.precision(layer);
        product(precision, x, self.kernel(layer), out, inputs, outputs);
    }

    /// The transposed kernel of the output layer, `outputs × width`.
    fn output_rows<'b>(&self, transposed: &'b mut Buffer) -> &'b [f32]
    where
        'a: 'b,
    {
        let (kernel, (width, outputs)) = (self.kernel(self.last()), self.layers.shape(self.last()));
        if outputs == 1 {
            return kernel;
        }
        let rows = transposed.sized(kernel.len());
        for h in 0..width {
            for j in 0..outputs {
                rows[j * width + h] = kernel[h * outputs + j];
            }
        }
        rows
    }

    /// Packs the kernels between hidden layers; `None` where packing gains nothing.
    pub fn pack(&self) -> Option<Vec<Packed>> {
        let pack = |layer| {
            let (inputs, outputs) = self.layers.shape(layer);
            let precision = self.layers.precision(layer);
            Packed::new(precision, self.kernel(layer), inputs, outputs)
        };
        (1..self.last()).map(pack).collect()
    }

    /// `out[rows × outputs]` of a tile, whose state part is from [`Self::first_part`].
    pub fn forward(&self, input: FirstLayer<'_>, work: &mut Workspace, out: &mut [f32]) {
        let (outputs, width, last) = (self.layers.outputs(), self.width(), self.last());
        let action_dim = input.kernel.len() / width;
        let [x, y] = &mut work.pair;
        let output = self.output_rows(&mut work.output);
        let block = match self.packed {
            Some(_) if self.layers.is_rounded() => BLOCK,
            _ => TILE,
        };
        let states = (block / input.repeat).max(1);
        let rows = states * input.repeat;
        let blocks = input.base.chunks(states * width);
        let blocks = blocks.zip(out.chunks_mut(rows * outputs));
        for (i, (base, out)) in blocks.enumerate() {
            let count = out.len() / outputs;
            let actions = &input.actions[i * rows * action_dim..][..count * action_dim];
            let first = FirstLayer { base, actions, ..input };
            let out_of_first = x.sized(count * width);
            match self.norm(0) {
                Some([scale, shift]) if !self.layers.config.norm_after => {
                    first_layer(None, &first, out_of_first);
                    let saved = work.norm_scratch.sized(saved_len(count, width));
                    normalize(out_of_first, None, scale, self.layers.epsilon(), saved);
                    activate(self.layers.config.activation, out_of_first, shift);
                }
                _ => {
                    first_layer(Some(self.layers.config.activation), &first, out_of_first);
                    self.normalize_after(0, out_of_first, || {
                        work.norm_scratch.sized(saved_len(count, width))
                    });
                }
            }
            for layer in 1..last {
                let (inputs, width) = self.layers.shape(layer);
                let (x, y) = if layer % 2 == 1 { (&mut *x, &mut *y) } else { (&mut *y, &mut *x) };
                let (x, y) = (x.sized(count * inputs), y.sized(count * width));
                match self.packed {
                    Some(kernels) => kernels[layer - 1].product(x, y),
                    None => self.product(layer, x, y),
                }
                let bias =
                    self.normalize(layer, y, || work.norm_scratch.sized(saved_len(count, width)));
                activate(self.layers.config.activation, y, bias);
                self.normalize_after(layer, y, || work.norm_scratch.sized(saved_len(count, width)));
            }
            let width = self.layers.shape(last).0;
            let x = if last % 2 == 1 { &mut *x } else { &mut *y };
            dots(x.sized(count * width), output, self.bias(last), out, width);
        }
    }

    /// [`Self::forward`] of rows `rows × inputs` that saves activations and slopes for
    /// [`Self::backward`].
    pub fn forward_saving(
        &self,
        input: &[f32],
        saved: &mut Activations<'_>,
        work: &mut Workspace,
        out: &mut [f32],
    ) {
        let last = self.last();
        for layer in 0..last {
            let (before, here) = saved.x.split_at_mut(layer);
            let x = before.last().map_or(input, |x| &**x);
            self.product(layer, x, here[0]);
            let bias = self.normalize(layer, here[0], || saved.norm[layer]);
            let activation = self.layers.config.activation;
            activate_with_slope(activation, here[0], bias, saved.slope[layer]);
            self.normalize_after(layer, here[0], || saved.norm[layer]);
        }
        let output = self.output_rows(&mut work.output);
        let width = self.layers.shape(last).0;
        dots(saved.x[last - 1], output, self.bias(last), out, width);
    }

    /// Adds the bias and normalizes, if the layer has a norm before its activation. Returns the
    /// vector that is then added: the norm's shift, or the bias.
    fn normalize<'b>(
        &self,
        layer: usize,
        x: &mut [f32],
        saved: impl FnOnce() -> &'b mut [f32],
    ) -> &'a [f32] {
        let bias = self.bias(layer);
        match self.norm(layer) {
            Some([scale, shift]) if !self.layers.config.norm_after => {
                normalize(x, Some(bias), scale, self.layers.epsilon(), saved());
                shift
            }
            _ => bias,
        }
    }

    /// Normalizes after the activation, if the layer has its norm there.
    fn normalize_after<'b>(
        &self,
        layer: usize,
        x: &mut [f32],
        saved: impl FnOnce() -> &'b mut [f32],
    ) {
        if let Some([scale, shift]) = self.norm(layer).filter(|_| self.layers.config.norm_after) {
            normalize(x, None, scale, self.layers.epsilon(), saved());
            shift_rows(x, shift);
        }
    }

    /// Turns the saved slopes into the gradients δ before each activation and norm, given the
    /// output's gradient.
    pub fn backward(
        &self,
        output_gradient: &[f32],
        saved: &mut Activations<'_>,
        work: &mut Workspace,
    ) {
        let (last, after) = (self.last(), self.layers.config.norm_after);
        let Activations { slope, norm, .. } = saved;
        let mut through_norm = |layer: usize, here: bool, delta: &mut [f32]| {
            if let Some([scale, _]) = self.norm(layer).filter(|_| here) {
                normalize_backward(delta, scale, norm[layer]);
            }
        };
        let output = self.output_rows(&mut work.output);
        let (top, width) = (&mut *slope[last - 1], self.layers.shape(last).0);
        if self.layers.config.norm && after {
            let temporary = work.pair[0].sized(top.len());
            temporary.fill(1.0);
            scale_by_combination(temporary, output_gradient, output, width);
            through_norm(last - 1, true, temporary);
            multiply(top, temporary);
        } else {
            scale_by_combination(top, output_gradient, output, width);
            through_norm(last - 1, true, top);
        }
        for layer in (1..last).rev() {
            let (inputs, width) = self.layers.shape(layer);
            let (below, above) = slope.split_at_mut(layer);
            let (below, above) = (&mut *below[layer - 1], &*above[0]);
            let temporary = work.pair[0].sized(below.len());
            let (precision, kernel) = (self.layers.precision(layer), self.kernel(layer));
            product_transposed(precision, above, kernel, temporary, inputs, width);
            through_norm(layer - 1, after, temporary);
            multiply(below, temporary);
            through_norm(layer - 1, !after, below);
        }
    }

    /// After [`Self::backward`]: the gradient of inputs `from..from + count`, `rows × count`.
    pub fn input_gradient(&self, first: &[f32], (from, count): (usize, usize), out: &mut [f32]) {
        let (kernel, width) = (self.first_kernel(from, count), self.width());
        match count {
            // A library's product is slow at few columns.
            0..=NARROW => dots(first, kernel, &[0.0; NARROW][..count], out, width),
            _ => product_transposed(self.layers.precision(0), first, kernel, out, count, width),
        }
    }
}

/// Rows `from..from + count`, fewer at the end, of a matrix with `width` columns.
pub(crate) fn row_slice(matrix: &[f32], from: usize, count: usize, width: usize) -> &[f32] {
    let end = ((from + count) * width).min(matrix.len());
    &matrix[from * width..end]
}
