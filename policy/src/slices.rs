//! Candle's CPU tensors as slices.

use candle_core::{CpuStorage, Device, Error, InplaceOp1, Layout, Result, Storage, Tensor};

/// Whether operations on this device run in their fast bodies: on the CPU, unless the feature `plain` says otherwise.
pub fn has_fast_body(device: &Device) -> bool {
    device.is_cpu() && !cfg!(feature = "plain")
}

/// The numbers behind a contiguous layout.
pub(crate) fn slice<'a, T: candle_core::WithDType>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [T]> {
    let Some((from, to)) = layout.contiguous_offsets() else { candle_core::bail!("a tensor is not contiguous") };
    Ok(&storage.as_slice()?[from..to])
}

/// Hands the numbers of a contiguous tensor on the CPU to `work`.
pub fn read<T: candle_core::WithDType, R>(tensor: &Tensor, work: impl FnOnce(&[T]) -> R) -> Result<R> {
    let (storage, layout) = tensor.storage_and_layout();
    let Storage::Cpu(storage) = &*storage else { candle_core::bail!("a tensor is not on the CPU") };
    Ok(work(slice(storage, layout)?))
}

/// Has `work` change the numbers of a contiguous tensor on the CPU in place.
pub fn modify(tensor: &Tensor, work: impl Fn(&mut [f32])) -> Result<()> {
    struct Modify<F>(F);
    impl<F: Fn(&mut [f32])> InplaceOp1 for Modify<F> {
        fn name(&self) -> &'static str {
            "modify"
        }

        fn cpu_fwd(&self, storage: &mut CpuStorage, layout: &Layout) -> Result<()> {
            let (CpuStorage::F32(numbers), Some((from, to))) = (storage, layout.contiguous_offsets()) else {
                return Err(Error::Msg("only contiguous tensors of f32 can be changed in place".into()));
            };
            (self.0)(&mut numbers[from..to]);
            Ok(())
        }
    }
    tensor.inplace_op1(&Modify(work))
}
