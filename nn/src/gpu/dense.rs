//! Dense layers on a GPU as operations of candle's, one kernel each (`quad_kernels::cuda_mlp`).

use crate::gpu::tensors::{read, stream, tensor, view, with_views};
use crate::layers::flat::Layers;
use crate::layers::plain;
use crate::weights::Weights;
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CudaStorage, CustomOp2, Error, Layout, Result, Shape, Tensor, bail};
use quad_kernels::cuda_mlp::{Dense, Part, Saved};
use std::sync::{Mutex, PoisonError};

/// The networks of these layers, if kernels run them: on a GPU, without a norm and not too wide.
pub(crate) fn dense(layers: &Layers, weights: &Weights) -> Option<Dense> {
    if layers.config.norm || !weights.values().device().is_cuda() {
        return None;
    }
    let widths = (0..layers.count()).map(|layer| layers.shape(layer).0);
    let widths = Vec::from_iter(widths.chain([layers.outputs()]));
    Dense::new(layers.range().start, layers.members, &widths, layers.config.activation)
}

/// Calls `work` with contiguous tensors `[n, width]` as parts of the inputs of `rows` rows.
fn with_parts<R>(
    tensors: &[Tensor],
    rows: usize,
    work: impl FnOnce(&[Part<'_>]) -> Result<R>,
) -> Result<R> {
    let dims = tensors.iter().map(Tensor::dims2).collect::<Result<Vec<_>>>()?;
    with_views(tensors, |views| {
        let parts = dims.iter().zip(views).map(|((n, width), numbers)| Part {
            numbers,
            width: *width,
            repeat: rows / n,
        });
        work(&Vec::from_iter(parts))
    })
}

fn contiguous<'a>(tensors: impl IntoIterator<Item = &'a Tensor>) -> Result<Vec<Tensor>> {
    tensors.into_iter().map(Tensor::contiguous).collect()
}

/// The outputs `[K, rows, out]` for the inputs of [`crate::layers::mlp::Mlp::forward`].
pub(crate) fn forward(dense: Dense, weights: &Weights, inputs: &[&Tensor]) -> Result<Tensor> {
    let Some((last, first)) = inputs.split_last() else { bail!("networks got no inputs") };
    let rows = last.dim(0)?;
    // The operation has a gradient of the last part only.
    let parts = match first.iter().any(|input| input.track_op()) {
        true => vec![plain::side_by_side(inputs)?],
        false => contiguous(inputs.iter().copied())?,
    };
    let width: usize = parts.iter().map(|part| part.dim(1)).sum::<Result<_>>()?;
    if width != dense.inputs() {
        bail!("networks of {} numbers got {width}", dense.inputs());
    }
    let (values, last) = (weights.values(), parts[parts.len() - 1].clone());
    let differentiable = values.track_op() || last.track_op();
    let parts = Vec::from_iter(parts.iter().map(Tensor::detach));
    let operation = Forward { dense, parts, rows, differentiable, saved: Mutex::default() };
    match differentiable {
        true => values.apply_op2(&last, operation),
        false => values.apply_op2_no_bwd(&last, &operation),
    }
}

/// The gradients of the outputs' sum with respect to the last of the inputs, `[K, rows, width]`.
pub(crate) fn input_gradients(
    dense: Dense,
    weights: &Weights,
    inputs: &[&Tensor],
) -> Result<Tensor> {
    let parts = contiguous(inputs.iter().copied())?;
    let (rows, width) = parts[parts.len() - 1].dims2()?;
    let values = weights.values().detach();
    let stream = stream(&values)?;
    let gradients = read(&values, |values| {
        with_parts(&parts, rows, |parts| {
            let (_, saved) =
                dense.forward(&stream, values, parts, rows, true).map_err(Error::wrap)?;
            let Some(saved) = saved else { bail!("nothing was saved") };
            dense.backward(&stream, values, &saved, (None, rows), width, None).map_err(Error::wrap)
        })
    })?;
    let Some(gradients) = gradients else { bail!("there is no gradient of inputs") };
    tensor(gradients, (dense.members(), rows, width), &values)
}

/// Samples `[rows, a]` of a reverse process with the coefficients `steps`, `[T, 7]`, for
/// observations `[n, o]`, embeddings `[T, e]` and noise `[T, rows, a]`.
pub(crate) fn sample(
    dense: Dense,
    weights: &Weights,
    [observations, embeddings]: [&Tensor; 2],
    noise: &Tensor,
    steps: &Tensor,
) -> Result<Tensor> {
    let (_, rows, a) = noise.dims3()?;
    let parts = contiguous([observations, embeddings])?;
    let (values, noise) = (weights.values().detach(), noise.contiguous()?);
    let stream = stream(&values)?;
    let samples = read(&values, |values| {
        read(&noise, |noise| {
            read(steps, |steps| {
                with_parts(&parts, rows, |parts| {
                    let [observations, embeddings] = parts else { bail!("two parts") };
                    let parts = [observations, embeddings];
                    dense.sample(&stream, values, parts, noise, steps).map_err(Error::wrap)
                })
            })
        })
    })?;
    tensor(samples, (rows, a), &values)
}

/// The operation of (weights, the last part of the inputs).
struct Forward {
    dense: Dense,
    /// All parts of the inputs, as constants.
    parts: Vec<Tensor>,
    rows: usize,
    differentiable: bool,
    /// For the backward pass.
    saved: Mutex<Option<Saved>>,
}

impl CustomOp2 for Forward {
    fn name(&self) -> &'static str {
        "dense-layers"
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        bail!("a tensor is not on the GPU")
    }

    fn cuda_fwd(
        &self,
        weights: &CudaStorage,
        layout: &Layout,
        _: &CudaStorage,
        _: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        let (stream, values) = (weights.device.cuda_stream(), view(weights, layout)?);
        let (out, saved) = with_parts(&self.parts, self.rows, |parts| {
            let Self { dense, rows, differentiable, .. } = *self;
            dense.forward(&stream, &values, parts, rows, differentiable).map_err(Error::wrap)
        })?;
        *self.saved.lock().unwrap_or_else(PoisonError::into_inner) = saved;
        let shape = (self.dense.members(), self.rows, self.dense.outputs()).into();
        Ok((CudaStorage::wrap_cuda_slice(out, weights.device().clone()), shape))
    }

    fn bwd(
        &self,
        weights: &Tensor,
        x: &Tensor,
        _: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let saved = self.saved.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(saved) = &*saved else { bail!("nothing was saved") };
        let (gradient, stream) = (gradient.contiguous()?, stream(weights)?);
        let width = if x.track_op() { x.dim(1)? } else { 0 };
        let mut weights_gradient = match weights.track_op() {
            true => Some(stream.alloc_zeros(weights.elem_count()).map_err(Error::wrap)?),
            false => None,
        };
        let gradient = read(&weights.detach(), |values| {
            read(&gradient, |gradient| {
                let gradient = (Some(gradient), self.rows);
                let out = weights_gradient.as_mut();
                self.dense
                    .backward(&stream, values, saved, gradient, width, out)
                    .map_err(Error::wrap)
            })
        })?;
        let inputs_gradient = gradient.map(|gradient| {
            let members = self.dense.members();
            let gradient = tensor(gradient, (members, self.rows, width), x)?;
            match members {
                1 => gradient.squeeze(0),
                _ => gradient.sum(0),
            }
        });
        let tensor = |gradient| tensor(gradient, weights.shape(), weights);
        let weights_gradient = weights_gradient.map(tensor);
        Ok((weights_gradient.transpose()?, inputs_gradient.transpose()?))
    }
}
