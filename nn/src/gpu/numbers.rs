//! A loss and QUAD's guidance on a GPU, a kernel each.

use crate::gpu::tensors::{read, stream, tensor, view, with_views};
use candle_core::cuda_backend::cudarc::driver::{CudaSlice, CudaView};
use candle_core::{CpuStorage, CudaStorage, CustomOp1, Error, Layout, Result, Shape, Tensor, bail};
use quad_kernels::cuda;

/// [`crate::squared_error`], or with a weight and a pull [`crate::pulled_error`].
pub(crate) fn squared_error(
    x: &Tensor,
    y: &Tensor,
    pulled: Option<[&Tensor; 2]>,
) -> Result<Tensor> {
    let constants = [y].into_iter().chain(pulled.into_iter().flatten());
    let constants = constants.map(|x| x.detach().contiguous()).collect::<Result<_>>()?;
    x.contiguous()?.apply_op1(SquaredError(constants))
}

/// The operation of x; y, and the weight and the pull if there are any, are constants.
struct SquaredError(Vec<Tensor>);

impl SquaredError {
    fn run(
        &self,
        x: &CudaView<'_, f32>,
        gradient: Option<&CudaView<'_, f32>>,
    ) -> Result<CudaSlice<f32>> {
        let stream = stream(&self.0[0])?;
        with_views(&self.0, |constants| {
            let pulled =
                constants.get(1).zip(constants.get(2)).map(|(weight, pull)| [weight, pull]);
            cuda::squared_error(&stream, [x, &constants[0]], pulled, gradient).map_err(Error::wrap)
        })
    }
}

impl CustomOp1 for SquaredError {
    fn name(&self) -> &'static str {
        "squared-error"
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        bail!("a tensor is not on the GPU")
    }

    fn cuda_fwd(&self, x: &CudaStorage, layout: &Layout) -> Result<(CudaStorage, Shape)> {
        let error = self.run(&view(x, layout)?, None)?;
        Ok((CudaStorage::wrap_cuda_slice(error, x.device.clone()), ().into()))
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        let gradient = read(x, |view| read(gradient, |gradient| self.run(view, Some(gradient))))?;
        tensor(gradient, x.shape(), x).map(Some)
    }
}

/// QUAD's guidance on a GPU: from critics' values `[K, B]` and gradients `[K, B, a]`, the predicted
/// noise `[B, a]` and ν̂² `[]`, with τ, δ and the EMA rate of ν̂². One vector has the mean gradient `B × a`,
/// then σ² and λ of each row, the share of rows where δ decides λ, and the new ν̂².
pub fn guide(tensors: [&Tensor; 4], numbers: [f32; 3]) -> Result<Tensor> {
    let [_, _, predicted, _] = tensors;
    let ((rows, a), stream) = (predicted.dims2()?, stream(predicted)?);
    let contiguous = tensors.iter().map(|x| x.contiguous()).collect::<Result<Vec<_>>>()?;
    let guide = with_views(&contiguous, |views| {
        let [values, gradients, predicted, nu_squared] = views else { bail!("four tensors") };
        let tensors = [values, gradients, predicted, nu_squared];
        cuda::guide(&stream, tensors, a, numbers).map_err(Error::wrap)
    })?;
    tensor(guide, rows * (a + 2) + 2, predicted)
}
