//! Candle's CPU tensors as slices.

use std::cell::Cell;

use candle_core::{CpuStorage, Device, Error, InplaceOp1, Layout, Result, Storage, Tensor};

/// Whether operations on this device have a fast implementation: on the CPU, unless the feature
/// `plain` says otherwise.
pub fn has_fast_implementation(device: &Device) -> bool {
    #[cfg(test)]
    if PLAINLY.get() {
        return false;
    }
    device.is_cpu() && !cfg!(feature = "plain")
}

#[cfg(test)]
thread_local! {
    static PLAINLY: Cell<bool> = const { Cell::new(false) };
}

/// What `work` gives where nothing has a fast implementation.
#[cfg(test)]
pub(crate) fn plainly<R>(work: impl FnOnce() -> R) -> R {
    PLAINLY.set(true);
    let result = work();
    PLAINLY.set(false);
    result
}

/// The numbers behind a contiguous layout.
pub(crate) fn slice<'a, T: candle_core::WithDType>(
    storage: &'a CpuStorage,
    layout: &Layout,
) -> Result<&'a [T]> {
    let Some((from, to)) = layout.contiguous_offsets() else {
        candle_core::bail!("a tensor is not contiguous")
    };
    Ok(&storage.as_slice()?[from..to])
}

/// The numbers of a contiguous tensor on the CPU.
pub(crate) fn on_cpu<'a, T: candle_core::WithDType>(
    storage: &'a Storage,
    layout: &Layout,
) -> Result<&'a [T]> {
    match storage {
        Storage::Cpu(storage) => slice(storage, layout),
        _ => candle_core::bail!("a tensor is not on the CPU"),
    }
}

/// Hands the numbers of a contiguous tensor on the CPU to `work`.
pub fn read<T: candle_core::WithDType, R>(
    tensor: &Tensor,
    work: impl FnOnce(&[T]) -> R,
) -> Result<R> {
    let (storage, layout) = tensor.storage_and_layout();
    Ok(work(on_cpu(&storage, layout)?))
}

/// Has `work` change the numbers of a contiguous tensor on the CPU in place.
pub fn modify<R>(tensor: &Tensor, work: impl FnOnce(&mut [f32]) -> R) -> Result<R> {
    /// Candle asks for an operation that could be applied many times; this one is applied once.
    struct Once<F, R>(Cell<Option<F>>, Cell<Option<R>>);
    impl<R, F: FnOnce(&mut [f32]) -> R> InplaceOp1 for Once<F, R> {
        fn name(&self) -> &'static str {
            "modify"
        }

        fn cpu_fwd(&self, storage: &mut CpuStorage, layout: &Layout) -> Result<()> {
            let (CpuStorage::F32(numbers), Some((from, to)), Some(work)) =
                (storage, layout.contiguous_offsets(), self.0.take())
            else {
                return Err(Error::Msg(
                    "only contiguous tensors of f32 can be changed in place".into(),
                ));
            };
            self.1.set(Some(work(&mut numbers[from..to])));
            Ok(())
        }
    }
    let once = Once(Cell::new(Some(work)), Cell::new(None));
    tensor.inplace_op1(&once)?;
    once.1.take().ok_or_else(|| Error::Msg("a tensor is not on the CPU".into()))
}
