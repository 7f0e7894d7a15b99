//! Candle's CPU tensors as slices.

use candle_core::{
    CpuStorage, Device, Error, InplaceOp1, Layout, Result, Storage, Tensor, WithDType, bail,
};
use std::cell::Cell;

/// True on the CPU, unless the feature `plain` asks for candle's own operations there, too.
pub(crate) fn has_fast_implementation(device: &Device) -> bool {
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

/// The result of `work` in candle's own operations.
#[cfg(test)]
pub(crate) fn plainly<R>(work: impl FnOnce() -> R) -> R {
    PLAINLY.set(true);
    let result = work();
    PLAINLY.set(false);
    result
}

/// The numbers behind a contiguous layout.
pub(crate) fn slice<'a, T: WithDType>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [T]> {
    let Some((from, to)) = layout.contiguous_offsets() else { bail!("a tensor is not contiguous") };
    Ok(&storage.as_slice()?[from..to])
}

/// The numbers of a contiguous tensor on the CPU.
pub(crate) fn on_cpu<'a, T: WithDType>(storage: &'a Storage, layout: &Layout) -> Result<&'a [T]> {
    match storage {
        Storage::Cpu(storage) => slice(storage, layout),
        _ => bail!("a tensor is not on the CPU"),
    }
}

/// Calls `work` with the numbers of a contiguous tensor on the CPU.
pub fn read<T: WithDType, R>(tensor: &Tensor, work: impl FnOnce(&[T]) -> R) -> Result<R> {
    let (storage, layout) = tensor.storage_and_layout();
    Ok(work(on_cpu(&storage, layout)?))
}

/// Calls `work` with the numbers of several contiguous tensors on the CPU.
pub(crate) fn read_all<const N: usize, R>(
    tensors: [&Tensor; N],
    work: impl FnOnce([&[f32]; N]) -> R,
) -> Result<R> {
    let held = tensors.map(Tensor::storage_and_layout);
    let mut slices = [&[][..]; N];
    for (slice, (storage, layout)) in slices.iter_mut().zip(&held) {
        *slice = on_cpu(storage, layout)?;
    }
    Ok(work(slices))
}

/// Lets `work` change the numbers of a contiguous tensor on the CPU in place.
pub(crate) fn modify<R>(tensor: &Tensor, work: impl FnOnce(&mut [f32]) -> R) -> Result<R> {
    /// Candle takes operations that can be applied many times; this one is applied once.
    struct Once<F, R>(Cell<Option<F>>, Cell<Option<R>>);
    impl<R, F: FnOnce(&mut [f32]) -> R> InplaceOp1 for Once<F, R> {
        fn name(&self) -> &'static str {
            "modify"
        }

        fn cpu_fwd(&self, storage: &mut CpuStorage, layout: &Layout) -> Result<()> {
            let (CpuStorage::F32(numbers), Some((from, to)), Some(work)) =
                (storage, layout.contiguous_offsets(), self.0.take())
            else {
                bail!("only contiguous tensors of f32 can be changed in place")
            };
            self.1.set(Some(work(&mut numbers[from..to])));
            Ok(())
        }
    }
    let once = Once(Cell::new(Some(work)), Cell::new(None));
    tensor.inplace_op1(&once)?;
    once.1.take().ok_or_else(|| Error::Msg("a tensor is not on the CPU".into()))
}
