//! Where the layers of some networks of one shape lie in one flat vector.
//!
//! A vector for all weights keeps an optimiser's step at one operation, and each named tensor is one contiguous run of it:
//! layer after layer the kernels of all members, then their biases.

use crate::weights::Part;

/// Linear layers of given widths for K members: for each layer K kernels `[in, out]`, then K biases `[out]`.
#[derive(Clone, Debug)]
pub(crate) struct Layers {
    members: usize,
    widths: Vec<usize>,
    /// Of each layer's first kernel; behind the last layer, of the end.
    offsets: Vec<usize>,
}

/// Kernel and bias of one layer of one member, to be written.
pub(crate) struct LayerMut<'a> {
    pub layer: usize,
    pub member: usize,
    pub kernel: &'a mut [f32],
    pub bias: &'a mut [f32],
}

impl Layers {
    /// The first kernel lies at `start`.
    pub fn new(members: usize, widths: &[usize], start: usize) -> Self {
        let mut offsets = vec![start];
        for (layer, pair) in widths.windows(2).enumerate() {
            offsets.push(offsets[layer] + members * (pair[0] + 1) * pair[1]);
        }
        Self { members, widths: widths.to_vec(), offsets }
    }

    pub fn count(&self) -> usize {
        self.widths.len() - 1
    }

    /// Where the last layer ends.
    pub fn end(&self) -> usize {
        self.offsets[self.count()]
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

    /// All kernels and biases in the part of a vector that is these layers'. They share nothing, so that each may be
    /// written by another thread.
    pub fn split_mut<'a>(&self, mut rest: &'a mut [f32]) -> Vec<LayerMut<'a>> {
        let mut all = Vec::with_capacity(self.count() * self.members);
        for layer in 0..self.count() {
            let (inputs, outputs) = self.shape(layer);
            let (kernels, behind) = rest.split_at_mut(self.members * inputs * outputs);
            let (biases, behind) = behind.split_at_mut(self.members * outputs);
            rest = behind;
            let members = kernels.chunks_exact_mut(inputs * outputs).zip(biases.chunks_exact_mut(outputs));
            all.extend(members.enumerate().map(|(member, (kernel, bias))| LayerMut { layer, member, kernel, bias }));
        }
        all
    }

    /// Names, shapes and offsets of the tensors `{prefix}.{layer}.kernel` and `.bias`; `leading` says whether the number
    /// of members is their first dimension.
    pub fn named(&self, prefix: &str, leading: bool) -> Vec<Part> {
        let members = leading.then_some(self.members);
        let part = |layer: usize, kind: &str, shape: &[usize], offset| Part {
            name: format!("{prefix}{layer}.{kind}"),
            shape: members.into_iter().chain(shape.iter().copied()).collect(),
            offset,
        };
        (0..self.count())
            .flat_map(|layer| {
                let ((inputs, outputs), offset) = (self.shape(layer), self.offsets[layer]);
                [
                    part(layer, "kernel", &[inputs, outputs], offset),
                    part(layer, "bias", &[outputs], offset + self.members * inputs * outputs),
                ]
            })
            .collect()
    }
}
