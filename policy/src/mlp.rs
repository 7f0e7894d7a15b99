//! Where the layers of a network lie in one flat parameter vector.

/// Linear layers of given widths; for each layer the kernel `[in, out]`, then the bias `[out]`.
#[derive(Clone, Debug)]
pub(crate) struct Mlp {
    widths: Vec<usize>,
    offsets: Vec<usize>,
}

impl Mlp {
    pub fn new(widths: &[usize]) -> Self {
        let mut offsets = vec![0];
        for (layer, pair) in widths.windows(2).enumerate() {
            offsets.push(offsets[layer] + pair[0] * pair[1] + pair[1]);
        }
        Self { widths: widths.to_vec(), offsets }
    }

    /// Number of parameters.
    pub fn len(&self) -> usize {
        self.offsets[self.layers()]
    }

    pub fn layers(&self) -> usize {
        self.widths.len() - 1
    }

    /// (inputs, outputs) of a layer.
    pub fn shape(&self, layer: usize) -> (usize, usize) {
        (self.widths[layer], self.widths[layer + 1])
    }

    /// Offset of a layer's kernel; its bias follows.
    pub fn offset(&self, layer: usize) -> usize {
        self.offsets[layer]
    }

    pub fn kernel<'a>(&self, parameters: &'a [f32], layer: usize) -> &'a [f32] {
        let (inputs, outputs) = self.shape(layer);
        &parameters[self.offsets[layer]..][..inputs * outputs]
    }

    pub fn bias<'a>(&self, parameters: &'a [f32], layer: usize) -> &'a [f32] {
        let (inputs, outputs) = self.shape(layer);
        &parameters[self.offsets[layer] + inputs * outputs..][..outputs]
    }

    /// Kernel and bias of a layer, for writing.
    pub fn layer_mut<'a>(&self, parameters: &'a mut [f32], layer: usize) -> (&'a mut [f32], &'a mut [f32]) {
        let (inputs, outputs) = self.shape(layer);
        let layer = &mut parameters[self.offsets[layer]..self.offsets[layer + 1]];
        debug_assert_eq!(layer.len(), (inputs + 1) * outputs);
        layer.split_at_mut(inputs * outputs)
    }
}
