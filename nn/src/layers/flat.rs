//! Where the layers of some networks of one shape lie in one flat vector.
//!
//! A vector for all weights keeps an optimizer's step at one operation, and each named tensor is
//! one contiguous run of it: layer after layer the kernels of all members, then their biases, then
//! scales and shifts of the norm, if there is one.

use crate::layers::config::{Epsilon, Initial, MlpConfig};
use crate::weights::{Init, TensorSpec};
use candle_core::{Result, Tensor};
use quad_kernels::activation::Activation;
use std::ops::Range;

/// Rows that one task works on: weights and activations of a tile stay in a core's own cache.
pub(crate) const TILE: usize = 128;

/// Linear layers for K members: for each K kernels `[in, out]`, then K biases `[out]`.
#[derive(Clone, Debug)]
pub(crate) struct Layers {
    /// Networks side by side.
    pub members: usize,
    widths: Vec<usize>,
    /// Whether a norm stands between the hidden layers' linear maps and their activations.
    pub norm: bool,
    /// Whether it stands behind the activations instead.
    pub norm_after: bool,
    /// What it adds to the variance.
    pub norm_epsilon: Epsilon,
    pub activation: Activation,
    initial: Initial,
    /// Where each layer's parameters begin in the vector; behind the last layer, its end.
    offsets: Vec<usize>,
}

/// Parameters of one layer of one member, to be written.
pub(crate) struct LayerMut<'a> {
    pub layer: usize,
    pub member: usize,
    pub kernel: &'a mut [f32],
    pub bias: &'a mut [f32],
    /// Scale and shift of the norm, if the layer has one.
    pub norm: Option<[&'a mut [f32]; 2]>,
}

impl Layers {
    /// The first kernel lies at `start`.
    pub fn new(
        members: usize,
        inputs: usize,
        config: &MlpConfig,
        outputs: usize,
        start: usize,
    ) -> Self {
        let widths: Vec<usize> =
            [inputs].iter().chain(&config.hidden).chain(&[outputs]).copied().collect();
        let MlpConfig { norm, norm_after, norm_epsilon, activation, initial, .. } = *config;
        let offsets = vec![start];
        let mut layers =
            Self { members, widths, norm, norm_after, norm_epsilon, activation, initial, offsets };
        for layer in 0..layers.count() {
            let ((inputs, outputs), normed) = (layers.shape(layer), layers.is_normed(layer));
            let numbers = (inputs + if normed { 3 } else { 1 }) * outputs;
            layers.offsets.push(layers.offsets[layer] + members * numbers);
        }
        layers
    }

    pub fn count(&self) -> usize {
        self.widths.len() - 1
    }

    fn is_normed(&self, layer: usize) -> bool {
        self.norm && layer + 1 < self.count()
    }

    /// What a norm adds to the variance.
    pub fn epsilon(&self) -> f32 {
        self.norm_epsilon.value() as f32
    }

    /// Numbers that go in.
    pub fn inputs(&self) -> usize {
        self.widths[0]
    }

    /// Numbers that come out.
    pub fn outputs(&self) -> usize {
        self.widths[self.count()]
    }

    /// Widths of the hidden layers.
    pub fn hidden(&self) -> &[usize] {
        &self.widths[1..self.count()]
    }

    /// Where in the vector they lie.
    pub fn range(&self) -> Range<usize> {
        self.offsets[0]..self.offsets[self.count()]
    }

    /// (inputs, outputs) of a layer.
    pub fn shape(&self, layer: usize) -> (usize, usize) {
        (self.widths[layer], self.widths[layer + 1])
    }

    /// Kernels `[K, in, out]` and biases `[K, out]` of a layer, as views of the vector.
    pub fn views(&self, vector: &Tensor, layer: usize) -> Result<(Tensor, Tensor)> {
        let ((inputs, outputs), start, members) =
            (self.shape(layer), self.offsets[layer], self.members);
        let kernels = vector
            .narrow(0, start, members * inputs * outputs)?
            .reshape((members, inputs, outputs))?;
        let biases = vector.narrow(0, start + members * inputs * outputs, members * outputs)?;
        Ok((kernels, biases.reshape((members, outputs))?))
    }

    pub fn kernel<'a>(&self, weights: &'a [f32], layer: usize, member: usize) -> &'a [f32] {
        let (inputs, outputs) = self.shape(layer);
        &weights[self.offsets[layer] + member * inputs * outputs..][..inputs * outputs]
    }

    pub fn bias<'a>(&self, weights: &'a [f32], layer: usize, member: usize) -> &'a [f32] {
        let (inputs, outputs) = self.shape(layer);
        &weights[self.offsets[layer] + (self.members * inputs + member) * outputs..][..outputs]
    }

    /// Scale and shift of a layer's norm, if it has one.
    pub fn norm<'a>(
        &self,
        weights: &'a [f32],
        layer: usize,
        member: usize,
    ) -> Option<[&'a [f32]; 2]> {
        let (inputs, outputs) = self.shape(layer);
        let of = |kind| {
            &weights[self.offsets[layer] + (self.members * (inputs + kind) + member) * outputs..]
                [..outputs]
        };
        self.is_normed(layer).then(|| [of(1), of(2)])
    }

    /// All parameters in the part of a vector that is these layers'. They share nothing, so that
    /// each may be written by another thread.
    pub fn split_mut<'a>(&self, mut rest: &'a mut [f32]) -> Vec<LayerMut<'a>> {
        let mut all = Vec::with_capacity(self.count() * self.members);
        for layer in 0..self.count() {
            let (inputs, outputs) = self.shape(layer);
            let (kernels, behind) = rest.split_at_mut(self.members * inputs * outputs);
            let (biases, behind) = behind.split_at_mut(self.members * outputs);
            let norms = if self.is_normed(layer) { self.members * outputs } else { 0 };
            let (scales, behind) = behind.split_at_mut(norms);
            let (shifts, behind) = behind.split_at_mut(norms);
            rest = behind;
            let mut norms = scales.chunks_exact_mut(outputs).zip(shifts.chunks_exact_mut(outputs));
            let members =
                kernels.chunks_exact_mut(inputs * outputs).zip(biases.chunks_exact_mut(outputs));
            all.extend(members.enumerate().map(|(member, (kernel, bias))| {
                let norm = norms.next().map(|(scale, shift)| [scale, shift]);
                LayerMut { layer, member, kernel, bias, norm }
            }));
        }
        all
    }

    /// Names, shapes and initial values of the tensors `{prefix}{layer}.kernel` and `.bias`, and
    /// with a norm `.scale` and `.shift`; `leading` says whether the number of members is their
    /// first dimension.
    pub fn named(&self, prefix: &str, leading: bool) -> Vec<TensorSpec> {
        let mut parts = Vec::new();
        for layer in 0..self.count() {
            let (inputs, outputs) = self.shape(layer);
            let (kernel, bias) = self.initial.of_layer(inputs, outputs, layer + 1 == self.count());
            let mut push = |kind: &str, shape: &[usize], start| {
                let members = leading.then_some(&self.members);
                let shape = members.into_iter().chain(shape).copied().collect();
                parts.push(TensorSpec { name: format!("{prefix}{layer}.{kind}"), shape, start });
            };
            push("kernel", &[inputs, outputs], kernel);
            push("bias", &[outputs], bias);
            if self.is_normed(layer) {
                push("scale", &[outputs], Init::Constant(1.0));
                push("shift", &[outputs], Init::Constant(0.0));
            }
        }
        parts
    }
}
