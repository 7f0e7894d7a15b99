//! The loops of a gradient step on an Nvidia GPU, each one launch: Adam, EMA, a loss, and QUAD's
//! guidance. `cuda.cu` has the kernels.
//!
//! Every function queues its work on a stream and returns before the GPU has done it.

use crate::cuda_kernels::{Result, kernels};
use cudarc::driver::result::{device, mem_pool};
use cudarc::driver::sys::CUmemPool_attribute;
use cudarc::driver::{
    CudaContext, CudaSlice, CudaStream, CudaView, CudaViewMut, LaunchConfig, PushKernelArg,
};
use std::sync::Arc;

/// Threads of a block; `cuda.cu` counts on it.
const BLOCK: u32 = 256;
/// Partial sums of a gradient's norm.
const SUMS: usize = 256;

/// Prepares a process that computes on one stream. The driver keeps free memory, which it would
/// return whenever the host waits for the GPU, and arrays have no events, which would order streams.
pub fn prepare(context: &CudaContext) -> Result<()> {
    let mut bytes = u64::MAX;
    let threshold = CUmemPool_attribute::CU_MEMPOOL_ATTR_RELEASE_THRESHOLD;
    // SAFETY: the pool is that of the context's device, and this attribute is an unsigned number of
    // 64 bits.
    unsafe {
        let pool = device::get_default_mem_pool(context.cu_device())?;
        mem_pool::set_attribute(pool, threshold, (&raw mut bytes).cast())?;
    }
    // SAFETY: cudarc records events for streams that it has made, of which there are none.
    unsafe { context.disable_event_tracking() };
    Ok(())
}

/// One block.
const ONE: LaunchConfig =
    LaunchConfig { grid_dim: (1, 1, 1), block_dim: (BLOCK, 1, 1), shared_mem_bytes: 0 };

/// One thread for each number.
fn threads(count: usize) -> LaunchConfig {
    let blocks = u32::try_from(count).unwrap_or(u32::MAX).div_ceil(BLOCK);
    LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (BLOCK, 1, 1), shared_mem_bytes: 0 }
}

/// [`crate::optimizer::adam`] with the gradient scaled down to norm `clip`. Returns its norm before
/// that. `rates` are the fields of [`crate::optimizer::AdamRates`], on the GPU so that they can differ
/// at each replay of a CUDA graph.
pub fn adam(
    stream: &Arc<CudaStream>,
    parameters: &mut CudaViewMut<'_, f32>,
    moments: &mut CudaViewMut<'_, f32>,
    gradient: &CudaView<'_, f32>,
    clip: f32,
    rates: &CudaView<'_, f32>,
) -> Result<CudaSlice<f32>> {
    let count = gradient.len();
    assert!(parameters.len() == count && moments.len() == 2 * count, "two moments of each number");
    assert!(rates.len() == 3, "three rates");
    let kernels = kernels(stream)?;
    // SAFETY: the kernels write every number.
    let (mut partial, mut norm) = unsafe { (stream.alloc::<f32>(SUMS)?, stream.alloc::<f32>(1)?) };
    let len = count as u32;
    let mut launch = stream.launch_builder(&kernels.squares);
    launch.arg(gradient).arg(&mut partial).arg(&len);
    // SAFETY: the arguments are those of the kernel, which has a block for each of the sums.
    unsafe { launch.launch(threads(SUMS * BLOCK as usize))? };
    let (mut first, mut second) = moments.split_at_mut(count);
    let mut launch = stream.launch_builder(&kernels.adam);
    launch.arg(parameters).arg(&mut first).arg(&mut second);
    launch.arg(gradient).arg(&partial).arg(&mut norm);
    launch.arg(&len).arg(&clip).arg(rates);
    // SAFETY: the arguments are those of the kernel, and the lengths were checked above.
    unsafe { launch.launch(threads(count.min(1024 * BLOCK as usize)))? };
    Ok(norm)
}

/// `target += rate·(online - target)`.
pub fn ema(
    stream: &Arc<CudaStream>,
    target: &mut CudaViewMut<'_, f32>,
    online: &CudaView<'_, f32>,
    rate: f32,
) -> Result<()> {
    let count = target.len();
    assert!(online.len() == count, "equally many numbers");
    let kernels = kernels(stream)?;
    let len = count as u32;
    let mut launch = stream.launch_builder(&kernels.ema);
    launch.arg(target).arg(online).arg(&len).arg(&rate);
    // SAFETY: the arguments are those of the kernel, and the lengths were checked above.
    unsafe { launch.launch(threads(count))? };
    Ok(())
}

/// The mean of (x - y)², one number; with a weight and a pull, weight·mean((x - y)²) + mean(x·pull).
/// With the result's gradient: that of x. The numbers of x follow those of y, again and again.
pub fn squared_error(
    stream: &Arc<CudaStream>,
    [x, y]: [&CudaView<'_, f32>; 2],
    pulled: Option<[&CudaView<'_, f32>; 2]>,
    gradient: Option<&CudaView<'_, f32>>,
) -> Result<CudaSlice<f32>> {
    assert!(x.len().is_multiple_of(y.len()), "whole repetitions");
    let kernels = kernels(stream)?;
    // SAFETY: the kernels write every number.
    let mut out = unsafe { stream.alloc::<f32>(gradient.map_or(1, |_| x.len()))? };
    let (len, period, none) = (x.len() as u32, y.len() as u32, 0_u64);
    let (kernel, config) = match gradient {
        Some(_) => (&kernels.squared_error_gradient, threads(x.len())),
        None => (&kernels.squared_error, ONE),
    };
    let mut launch = stream.launch_builder(kernel);
    launch.arg(x).arg(y);
    match pulled {
        Some([weight, pull]) => launch.arg(weight).arg(pull),
        None => launch.arg(&none).arg(&none),
    };
    if let Some(gradient) = gradient {
        launch.arg(gradient);
    }
    launch.arg(&mut out).arg(&len).arg(&period);
    // SAFETY: the arguments are those of the kernel.
    unsafe { launch.launch(config)? };
    Ok(out)
}

/// QUAD's guidance by critics' values `members × rows` and gradients `members × rows × a`, the
/// predicted noise `rows × a` and ν̂², with τ, δ and the EMA rate of ν̂²: the mean gradient `rows × a`,
/// then σ² and λ of each row, the share of rows where δ decides λ, and the new ν̂².
pub fn guide(
    stream: &Arc<CudaStream>,
    [values, gradients, predicted, nu_squared]: [&CudaView<'_, f32>; 4],
    a: usize,
    [tau, delta, rate]: [f32; 3],
) -> Result<CudaSlice<f32>> {
    let rows = predicted.len() / a;
    let kernels = kernels(stream)?;
    // SAFETY: the kernel writes every number.
    let mut out = unsafe { stream.alloc::<f32>(rows * (a + 2) + 2)? };
    let (members, rows, a) = ((values.len() / rows) as u32, rows as u32, a as u32);
    let mut launch = stream.launch_builder(&kernels.guide);
    launch.arg(values).arg(gradients).arg(predicted).arg(nu_squared).arg(&mut out);
    launch.arg(&members).arg(&rows).arg(&a).arg(&tau).arg(&delta).arg(&rate);
    // SAFETY: the arguments are those of the kernel, and the lengths follow from each other.
    unsafe { launch.launch(ONE)? };
    Ok(out)
}
