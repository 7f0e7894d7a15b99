//! Candle's tensors on a GPU as arguments of `quad_kernels::cuda`.

use candle_core::cuda_backend::CudaDType;
use candle_core::cuda_backend::cudarc::driver::{
    CudaSlice, CudaStream, CudaView, CudaViewMut, DeviceRepr,
};
use candle_core::{
    CpuStorage, CudaStorage, Device, Error, InplaceOp1, Layout, Result, Shape, Storage, Tensor,
    WithDType, bail,
};
use std::cell::Cell;
use std::marker::PhantomData;
use std::sync::Arc;

/// Saves calls of the driver ([`quad_kernels::cuda::prepare`]).
pub(crate) fn prepare(device: &Device) -> Result<()> {
    let Device::Cuda(device) = device else { bail!("the device is not a GPU") };
    quad_kernels::cuda::prepare(device.cuda_stream().context()).map_err(Error::wrap)
}

fn range(layout: &Layout) -> Result<std::ops::Range<usize>> {
    match layout.contiguous_offsets() {
        Some((from, to)) => Ok(from..to),
        None => bail!("a tensor is not contiguous"),
    }
}

/// The numbers behind a contiguous layout.
pub(crate) fn view<'a>(storage: &'a CudaStorage, layout: &Layout) -> Result<CudaView<'a, f32>> {
    Ok(storage.as_cuda_slice::<f32>()?.slice(range(layout)?))
}

/// The stream of a tensor's GPU.
pub(crate) fn stream(tensor: &Tensor) -> Result<Arc<CudaStream>> {
    match tensor.device() {
        Device::Cuda(device) => Ok(device.cuda_stream()),
        _ => bail!("a tensor is not on the GPU"),
    }
}

/// Calls `work` with the numbers of contiguous tensors.
pub(crate) fn with_views<R>(
    tensors: &[Tensor],
    work: impl FnOnce(&[CudaView<'_, f32>]) -> Result<R>,
) -> Result<R> {
    let held = Vec::from_iter(tensors.iter().map(Tensor::storage_and_layout));
    let views = held.iter().map(|(storage, layout)| match &**storage {
        Storage::Cuda(storage) => view(storage, layout),
        _ => bail!("a tensor is not on the GPU"),
    });
    work(&views.collect::<Result<Vec<_>>>()?)
}

/// Calls `work` with the numbers of a contiguous tensor.
pub(crate) fn read<R>(
    tensor: &Tensor,
    work: impl FnOnce(&CudaView<'_, f32>) -> Result<R>,
) -> Result<R> {
    let (storage, layout) = tensor.storage_and_layout();
    match &*storage {
        Storage::Cuda(storage) => work(&view(storage, layout)?),
        _ => bail!("a tensor is not on the GPU"),
    }
}

/// Lets `work` change the numbers of a contiguous tensor in place, on its stream.
pub(crate) fn modify<T: CudaDType, R>(
    tensor: &Tensor,
    work: impl FnOnce(&Arc<CudaStream>, &mut CudaViewMut<'_, T>) -> Result<R>,
) -> Result<R> {
    /// Candle takes operations that can be applied many times; this one is applied once.
    struct Once<T, F, R>(Cell<Option<F>>, Cell<Option<R>>, PhantomData<T>);
    impl<T: CudaDType, R, F: FnOnce(&Arc<CudaStream>, &mut CudaViewMut<'_, T>) -> Result<R>>
        InplaceOp1 for Once<T, F, R>
    {
        fn name(&self) -> &'static str {
            "modify"
        }

        fn cpu_fwd(&self, _: &mut CpuStorage, _: &Layout) -> Result<()> {
            bail!("a tensor is not on the GPU")
        }

        fn cuda_fwd(&self, storage: &mut CudaStorage, layout: &Layout) -> Result<()> {
            let stream = storage.device.cuda_stream();
            let mut numbers = storage.as_cuda_slice_mut::<T>()?.slice_mut(range(layout)?);
            if let Some(work) = self.0.take() {
                self.1.set(Some(work(&stream, &mut numbers)?));
            }
            Ok(())
        }
    }
    let once = Once(Cell::new(Some(work)), Cell::new(None), PhantomData);
    tensor.inplace_op1(&once)?;
    once.1.take().ok_or_else(|| Error::Msg("a tensor is not on the GPU".into()))
}

/// Overwrites a contiguous tensor on the GPU by one on the CPU.
pub(crate) fn overwrite<T: CudaDType + DeviceRepr + WithDType>(
    tensor: &Tensor,
    with: &Tensor,
) -> Result<()> {
    if tensor.elem_count() != with.elem_count() {
        bail!("{:?} cannot be written over {:?}", with.shape(), tensor.shape());
    }
    let copy = |with: &[T]| {
        modify(tensor, |stream, numbers| stream.memcpy_htod(with, numbers).map_err(Error::wrap))
    };
    crate::slices::read(with, copy)?
}

/// A tensor of numbers on the GPU.
pub(crate) fn tensor(
    numbers: CudaSlice<f32>,
    shape: impl Into<Shape>,
    like: &Tensor,
) -> Result<Tensor> {
    let candle_core::Device::Cuda(device) = like.device() else {
        bail!("a tensor is not on the GPU")
    };
    let storage = Storage::Cuda(CudaStorage::wrap_cuda_slice(numbers, device.clone()));
    Ok(Tensor::from_storage(storage, shape, candle_core::op::BackpropOp::none(), false))
}
