//! Offsets of the layers of K networks in one flat vector.
//!
//! With one vector for all weights an optimizer's step is one operation. Each named tensor is
//! contiguous: layer after layer the kernels of all members, then their biases, then scales and
//! shifts of a norm.

use crate::layers::config::MlpConfig;
use crate::weights::{Init, TensorSpec};
use quad_kernels::Precision;
use std::ops::Range;

/// Rows of one task: weights and activations of a tile stay in a core's own cache.
pub(crate) const TILE: usize = 128;

/// Linear layers for K members: for each K kernels `[in, out]`, then K biases `[out]`.
#[derive(Clone, Debug)]
pub(crate) struct Layers {
    /// Number of networks, K.
    pub members: usize,
    pub config: MlpConfig,
    /// Arithmetic of the products between hidden layers.
    precision: Precision,
    widths: Vec<usize>,
    /// Start of each layer, and the end of the last.
    offsets: Vec<usize>,
}

/// Gradients of one layer of one member, to be written.
pub(crate) struct LayerMut<'a> {
    pub layer: usize,
    pub member: usize,
    pub precision: Precision,
    pub kernel: &'a mut [f32],
    pub bias: &'a mut [f32],
    /// Scale and shift of a norm.
    pub norm: Option<[&'a mut [f32]; 2]>,
}

impl Layers {
    /// Layers whose first kernel is at `start`.
    pub fn new(
        members: usize,
        (inputs, outputs): (usize, usize),
        config: MlpConfig,
        start: usize,
    ) -> Self {
        let widths = [&[inputs], &config.hidden[..], &[outputs]].concat();
        let offsets = vec![start];
        let precision = Precision::F32;
        let mut layers = Self { members, config, precision, widths, offsets };
        for layer in 0..layers.count() {
            let ((inputs, outputs), normed) = (layers.shape(layer), layers.is_normed(layer));
            let numbers = (inputs + 1 + 2 * usize::from(normed)) * outputs;
            layers.offsets.push(layers.offsets[layer] + members * numbers);
        }
        layers
    }

    /// These layers with products in this precision, if the CPU has it.
    pub fn with_precision(self, precision: Precision) -> Self {
        Self { precision: precision.in_effect(), ..self }
    }

    /// Arithmetic of the products with a layer's kernel. Inputs and outputs are not rounded: their
    /// products are few.
    pub fn precision(&self, layer: usize) -> Precision {
        match layer > 0 && layer + 1 < self.count() {
            true => self.precision,
            false => Precision::F32,
        }
    }

    /// True if products between hidden layers round their factors.
    pub fn is_rounded(&self) -> bool {
        self.precision(1) == Precision::Bf16
    }

    pub fn count(&self) -> usize {
        self.widths.len() - 1
    }

    fn is_normed(&self, layer: usize) -> bool {
        self.config.norm && layer + 1 < self.count()
    }

    pub fn epsilon(&self) -> f32 {
        self.config.norm_epsilon.value() as f32
    }

    pub fn inputs(&self) -> usize {
        self.widths[0]
    }

    pub fn outputs(&self) -> usize {
        self.widths[self.count()]
    }

    /// Range of the layers in the vector.
    pub fn range(&self) -> Range<usize> {
        self.offsets[0]..self.offsets[self.count()]
    }

    /// (inputs, outputs) of a layer.
    pub fn shape(&self, layer: usize) -> (usize, usize) {
        (self.widths[layer], self.widths[layer + 1])
    }

    pub fn kernel<'a>(&self, weights: &'a [f32], layer: usize, member: usize) -> &'a [f32] {
        let (inputs, outputs) = self.shape(layer);
        &weights[self.offsets[layer] + member * inputs * outputs..][..inputs * outputs]
    }

    pub fn bias<'a>(&self, weights: &'a [f32], layer: usize, member: usize) -> &'a [f32] {
        let (inputs, outputs) = self.shape(layer);
        &weights[self.offsets[layer] + (self.members * inputs + member) * outputs..][..outputs]
    }

    /// Scale and shift of a layer's norm.
    pub fn norm<'a>(
        &self,
        weights: &'a [f32],
        layer: usize,
        member: usize,
    ) -> Option<[&'a [f32]; 2]> {
        let (inputs, outputs) = self.shape(layer);
        let vector = |kind| {
            let before = (self.members * (inputs + kind) + member) * outputs;
            &weights[self.offsets[layer] + before..][..outputs]
        };
        self.is_normed(layer).then(|| [vector(1), vector(2)])
    }

    /// Splits the layers' range of a vector, so that each layer can be written by another thread.
    pub fn split_mut<'a>(&self, mut rest: &'a mut [f32]) -> Vec<LayerMut<'a>> {
        let mut split = Vec::with_capacity(self.count() * self.members);
        for layer in 0..self.count() {
            let ((inputs, outputs), precision) = (self.shape(layer), self.precision(layer));
            let (kernels, behind) = rest.split_at_mut(self.members * inputs * outputs);
            let (biases, behind) = behind.split_at_mut(self.members * outputs);
            let norms = usize::from(self.is_normed(layer)) * self.members * outputs;
            let (scales, behind) = behind.split_at_mut(norms);
            let (shifts, behind) = behind.split_at_mut(norms);
            rest = behind;
            let [biases, scales, shifts] =
                [biases, scales, shifts].map(|vectors| vectors.chunks_exact_mut(outputs));
            let mut norms = scales.zip(shifts);
            let members = kernels.chunks_exact_mut(inputs * outputs).zip(biases);
            split.extend(members.enumerate().map(|(member, (kernel, bias))| {
                let norm = norms.next().map(|(scale, shift)| [scale, shift]);
                LayerMut { layer, member, precision, kernel, bias, norm }
            }));
        }
        split
    }

    /// The tensors `{prefix}{layer}.kernel` and `.bias`, and with a norm `.scale` and `.shift`; with
    /// `leading` their first dimension is K.
    pub fn specs(&self, prefix: &str, leading: bool) -> Vec<TensorSpec> {
        let mut specs = Vec::new();
        for layer in 0..self.count() {
            let (inputs, outputs) = self.shape(layer);
            let (kernel, bias) =
                self.config.initial.layer(inputs, outputs, layer + 1 == self.count());
            let mut push = |kind: &str, shape: &[usize], init| {
                let members = leading.then_some(self.members);
                let shape: Vec<usize> = members.into_iter().chain(shape.iter().copied()).collect();
                let name = format!("{prefix}{layer}.{kind}");
                specs.push(TensorSpec { name, shape, init });
            };
            push("kernel", &[inputs, outputs], kernel);
            push("bias", &[outputs], bias);
            if self.is_normed(layer) {
                push("scale", &[outputs], Init::Constant(1.0));
                push("shift", &[outputs], Init::Constant(0.0));
            }
        }
        specs
    }
}
