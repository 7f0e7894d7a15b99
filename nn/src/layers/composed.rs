//! Layers act(x·W + b) whose backward pass is written out: candle's products, and one operation for
//! bias, activation and slope. A GPU launches two kernels a layer forward and four backward, with
//! candle's own differentiation some forty.

use crate::layers::flat::Layers;
use crate::slices::slice;
use crate::weights::Weights;
#[cfg(feature = "cuda")]
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp2, DType, Layout, Result, Shape, Storage, Tensor};
use quad_kernels::activation::{Activation, activate, activate_with_slope};
use std::sync::Arc;

/// A forward pass and the tensors that its backward pass reads.
pub(crate) struct Pass {
    layers: Arc<Layers>,
    /// Length of the vector of weights.
    count: usize,
    /// Kernels `[K, in, out]`.
    kernels: Vec<Tensor>,
    /// Inputs of each layer, `[K, rows, in]`.
    inputs: Vec<Tensor>,
    /// Slopes of the hidden layers' activations, `[K, rows, width]`; empty without gradients.
    slopes: Vec<Tensor>,
    /// `[K, rows, out]`.
    pub out: Tensor,
}

impl Pass {
    /// Computes the outputs of all members for the same inputs `[rows, in]`.
    pub fn forward(
        layers: &Arc<Layers>,
        weights: &Weights,
        x: &Tensor,
        differentiable: bool,
    ) -> Result<Self> {
        let values = weights.values().detach();
        let (rows, inputs) = x.dims2()?;
        // A view: all members read the same numbers.
        let x =
            x.detach().contiguous()?.unsqueeze(0)?.broadcast_as((layers.members, rows, inputs))?;
        let mut pass = Self {
            layers: layers.clone(),
            count: values.elem_count(),
            kernels: vec![],
            inputs: vec![],
            slopes: vec![],
            out: x,
        };
        for layer in 0..layers.count() {
            let (kernel, bias) = layers.views(&values, layer)?;
            let z = pass.out.matmul(&kernel)?;
            let last = layer + 1 == layers.count();
            let f = (!last).then_some(layers.config.activation);
            let slope = differentiable && !last;
            let activated = z.apply_op2_no_bwd(&bias, &Activate { f, slope })?;
            let y = activated.get(0)?;
            if slope {
                pass.slopes.push(activated.get(1)?);
            }
            if differentiable {
                pass.kernels.push(kernel);
                pass.inputs.push(std::mem::replace(&mut pass.out, y));
            } else {
                pass.out = y;
            }
        }
        Ok(pass)
    }

    /// The gradients, given the output's, `[K, rows, out]`: of the vector of weights, if `weights`,
    /// and of each member's inputs, `[K, rows, in]`, if `inputs`.
    pub fn backward(
        &self,
        gradient: &Tensor,
        weights: bool,
        inputs: bool,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let mut delta = gradient.contiguous()?;
        let mut parts = Vec::new();
        let (members, rows, _) = delta.dims3()?;
        let ones = Tensor::ones((1, 1, rows), DType::F32, delta.device())?
            .broadcast_as((members, 1, rows))?;
        for layer in (0..self.layers.count()).rev() {
            if weights {
                // In reverse: a layer's biases follow its kernels.
                parts.push(ones.matmul(&delta)?.flatten_all()?);
                parts.push(self.inputs[layer].t()?.matmul(&delta)?.flatten_all()?);
            }
            if layer > 0 {
                delta = (delta.matmul(&self.kernels[layer].t()?)? * &self.slopes[layer - 1])?;
            } else if inputs {
                delta = delta.matmul(&self.kernels[0].t()?)?;
            }
        }
        let weights = weights.then(|| self.whole(parts, delta.device())).transpose()?;
        Ok((weights, inputs.then_some(delta)))
    }

    /// The gradient of the whole vector from these layers' parts in reverse; 0 elsewhere.
    fn whole(&self, mut parts: Vec<Tensor>, device: &candle_core::Device) -> Result<Tensor> {
        let range = self.layers.range();
        let zeros = |count: usize| Tensor::zeros(count, DType::F32, device);
        if range.start > 0 {
            parts.push(zeros(range.start)?);
        }
        parts.reverse();
        if range.end < self.count {
            parts.push(zeros(self.count - range.end)?);
        }
        Tensor::cat(&parts, 0)
    }
}

/// The operation of (weights, inputs) through which candle differentiates a pass.
pub(crate) struct Composed(pub Pass);

impl Composed {
    /// A copy of the pass's output.
    fn output<S>(&self, copy: impl FnOnce(&Storage, &Layout) -> Result<S>) -> Result<(S, Shape)> {
        let (storage, layout) = self.0.out.storage_and_layout();
        Ok((copy(&storage, layout)?, layout.shape().clone()))
    }
}

impl CustomOp2 for Composed {
    fn name(&self) -> &'static str {
        "composed-mlp"
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        self.output(|storage, layout| {
            Ok(CpuStorage::F32(crate::slices::on_cpu(storage, layout)?.to_vec()))
        })
    }

    #[cfg(feature = "cuda")]
    fn cuda_fwd(
        &self,
        _: &candle_core::CudaStorage,
        _: &Layout,
        _: &candle_core::CudaStorage,
        _: &Layout,
    ) -> Result<(candle_core::CudaStorage, Shape)> {
        self.output(|storage, layout| match storage {
            Storage::Cuda(storage) => storage.try_clone(layout),
            _ => candle_core::bail!("a tensor is not on the GPU"),
        })
    }

    fn bwd(
        &self,
        weights: &Tensor,
        x: &Tensor,
        _: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (of_weights, of_inputs) =
            self.0.backward(gradient, weights.track_op(), x.track_op())?;
        Ok((of_weights, of_inputs.map(|gradient| gradient.sum(0)).transpose()?))
    }
}

/// The operation of (z `[K, rows, width]`, biases `[K, width]`): f(z + bias), `[1, K, rows, width]`;
/// with `slope` also f'(z + bias), `[2, K, rows, width]`. Without f, z + bias.
struct Activate {
    f: Option<Activation>,
    slope: bool,
}

impl Activate {
    fn shape(&self, z: &Layout) -> Shape {
        [&[if self.slope { 2 } else { 1 }], z.dims()].concat().into()
    }
}

impl CustomOp2 for Activate {
    fn name(&self) -> &'static str {
        "bias-activation"
    }

    fn cpu_fwd(
        &self,
        z: &CpuStorage,
        z_layout: &Layout,
        bias: &CpuStorage,
        l: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (z, bias): (&[f32], &[f32]) = (slice(z, z_layout)?, slice(bias, l)?);
        let (width, member) = (l.dims()[1], z.len() / l.dims()[0]);
        let mut out = z.to_vec();
        let mut slopes = vec![0.0; if self.slope { z.len() } else { 0 }];
        for (i, (out, bias)) in
            out.chunks_exact_mut(member).zip(bias.chunks_exact(width)).enumerate()
        {
            match self.f {
                Some(f) if self.slope => {
                    activate_with_slope(f, out, bias, &mut slopes[i * member..][..member])
                }
                Some(f) => activate(f, out, bias),
                None => out
                    .chunks_exact_mut(width)
                    .for_each(|row| row.iter_mut().zip(bias).for_each(|(x, b)| *x += b)),
            }
        }
        out.extend(slopes);
        Ok((CpuStorage::F32(out), self.shape(z_layout)))
    }

    #[cfg(feature = "cuda")]
    fn cuda_fwd(
        &self,
        z: &candle_core::CudaStorage,
        z_layout: &Layout,
        bias: &candle_core::CudaStorage,
        bias_layout: &Layout,
    ) -> Result<(candle_core::CudaStorage, Shape)> {
        use crate::gpu::tensors::{view, with_stream};
        let (z_view, bias_view) = (view(z, z_layout)?, view(bias, bias_layout)?);
        let out = with_stream(z, |stream| {
            let bias = (&bias_view, bias_layout.dims()[0]);
            quad_kernels::cuda::activate(stream, self.f, &z_view, bias, self.slope)
        })?;
        Ok((out, self.shape(z_layout)))
    }
}
