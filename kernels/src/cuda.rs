//! The loops of a gradient step on an Nvidia GPU, each one launch: activations, a reverse step,
//! Adam and EMA. Products are cuBLAS's, through candle. `cuda.cu` has the kernels; the driver's
//! compiler translates them for the GPU at hand when the first is launched.
//!
//! Every function queues its work on a stream and returns before the GPU has done it.

use crate::activation::Activation;
use cudarc::driver::result::{device, mem_pool};
use cudarc::driver::sys::CUmemPool_attribute;
use cudarc::driver::{
    CudaContext, CudaFunction, CudaSlice, CudaStream, CudaView, CudaViewMut, DriverError,
    LaunchConfig, PushKernelArg,
};
use cudarc::nvrtc::{CompileError, compile_ptx};
use std::sync::{Arc, Mutex, PoisonError};

/// Threads of a block; `cuda.cu` counts on it.
const BLOCK: u32 = 256;
/// Partial sums of a gradient's norm.
const SUMS: usize = 256;

/// A kernel that does not run.
#[derive(Debug, thiserror::Error)]
pub enum CudaError {
    /// The driver fails.
    #[error("the CUDA driver failed")]
    Driver(#[from] DriverError),
    /// The kernels cannot be compiled.
    #[error("the CUDA kernels cannot be compiled for this GPU")]
    Compile(#[from] CompileError),
}

/// Result of a kernel.
pub type Result<T> = std::result::Result<T, CudaError>;

/// Coefficients of a reverse step: `clean = clamp((x - deviation·ε)·scale)`, then
/// `clamp(from_clean·clean + from_noisy·x + noise·z)`. Bounds can be infinite.
#[derive(Clone, Copy, Debug)]
pub struct ReverseStep {
    /// Factor of the predicted noise ε.
    pub deviation: f32,
    /// Factor of the difference.
    pub scale: f32,
    /// Bound of `clean`.
    pub clean_bound: f32,
    /// Factor of `clean`.
    pub from_clean: f32,
    /// Factor of x.
    pub from_noisy: f32,
    /// Factor of the noise z; 0 without noise.
    pub noise: f32,
    /// Bound of the result.
    pub bound: f32,
}

/// The compiled kernels.
struct Kernels {
    activate: CudaFunction,
    reverse_step: CudaFunction,
    squares: CudaFunction,
    adam: CudaFunction,
    ema: CudaFunction,
}

/// The kernels, compiled by the first call. A process trains on one GPU.
fn kernels(stream: &CudaStream) -> Result<Arc<Kernels>> {
    static KERNELS: Mutex<Option<Arc<Kernels>>> = Mutex::new(None);
    let mut kernels = KERNELS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(kernels) = &*kernels {
        return Ok(kernels.clone());
    }
    let module = stream.context().load_module(compile_ptx(include_str!("cuda.cu"))?)?;
    let compiled = Kernels {
        activate: module.load_function("activate")?,
        reverse_step: module.load_function("reverse_step")?,
        squares: module.load_function("squares")?,
        adam: module.load_function("adam")?,
        ema: module.load_function("ema")?,
    };
    Ok(kernels.insert(Arc::new(compiled)).clone())
}

/// Prepares a process that computes on one stream. The driver keeps free memory, which it would
/// return whenever the host waits for the GPU, and arrays have no events, which would order streams.
pub fn prepare(context: &CudaContext) -> Result<()> {
    let mut all = u64::MAX;
    let threshold = CUmemPool_attribute::CU_MEMPOOL_ATTR_RELEASE_THRESHOLD;
    // SAFETY: the pool is that of the context's device, and this attribute is an unsigned number of
    // 64 bits.
    unsafe {
        let pool = device::get_default_mem_pool(context.cu_device())?;
        mem_pool::set_attribute(pool, threshold, (&raw mut all).cast())?;
    }
    // SAFETY: cudarc records events for streams that it has made, of which there are none.
    unsafe { context.disable_event_tracking() };
    Ok(())
}

/// One thread for each number.
fn threads(count: usize) -> LaunchConfig {
    let blocks = u32::try_from(count).unwrap_or(u32::MAX).div_ceil(BLOCK);
    LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (BLOCK, 1, 1), shared_mem_bytes: 0 }
}

/// `f(z + bias)` for z `members × rows × width` and bias `members × width`; without `f` the sum. With
/// `slope`, the derivatives f'(z + bias) follow all values.
pub fn activate(
    stream: &Arc<CudaStream>,
    f: Option<Activation>,
    z: &CudaView<'_, f32>,
    (bias, members): (&CudaView<'_, f32>, usize),
    slope: bool,
) -> Result<CudaSlice<f32>> {
    let (count, width) = (z.len(), bias.len() / members);
    assert!(count.is_multiple_of(members * width) && u32::try_from(count).is_ok(), "whole rows");
    let number = f.map_or(u32::MAX, |f| f as u32);
    let kernels = kernels(stream)?;
    // SAFETY: the kernel writes every number.
    let mut out = unsafe { stream.alloc::<f32>(if slope { 2 * count } else { count })? };
    let (mut y, mut derivative) = out.split_at_mut(count);
    let (all, member, width, none) = (count as u32, (count / members) as u32, width as u32, 0_u64);
    let mut launch = stream.launch_builder(&kernels.activate);
    launch.arg(z).arg(bias).arg(&mut y);
    if slope {
        launch.arg(&mut derivative)
    } else {
        launch.arg(&none)
    };
    launch.arg(&all).arg(&member).arg(&width).arg(&number);
    // SAFETY: the arguments are those of the kernel, and the lengths were checked above.
    unsafe { launch.launch(threads(count))? };
    Ok(out)
}

/// x_t → x_{t-1}; z is not read if `step.noise` is 0.
pub fn reverse(
    stream: &Arc<CudaStream>,
    [x, epsilon, z]: [&CudaView<'_, f32>; 3],
    step: ReverseStep,
) -> Result<CudaSlice<f32>> {
    let count = x.len();
    assert!(epsilon.len() == count && z.len() == count, "equally many numbers");
    let kernels = kernels(stream)?;
    // SAFETY: the kernel writes every number.
    let mut out = unsafe { stream.alloc::<f32>(count)? };
    let all = count as u32;
    let mut launch = stream.launch_builder(&kernels.reverse_step);
    launch.arg(x).arg(epsilon).arg(z).arg(&mut out).arg(&all);
    launch.arg(&step.deviation).arg(&step.scale).arg(&step.clean_bound).arg(&step.from_clean);
    launch.arg(&step.from_noisy).arg(&step.noise).arg(&step.bound);
    // SAFETY: the arguments are those of the kernel, and the lengths were checked above.
    unsafe { launch.launch(threads(count))? };
    Ok(out)
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
    let all = count as u32;
    let mut launch = stream.launch_builder(&kernels.squares);
    launch.arg(gradient).arg(&mut partial).arg(&all);
    // SAFETY: the arguments are those of the kernel, which has a block for each of the sums.
    unsafe { launch.launch(threads(SUMS * BLOCK as usize))? };
    let (mut first, mut second) = moments.split_at_mut(count);
    let mut launch = stream.launch_builder(&kernels.adam);
    launch
        .arg(parameters)
        .arg(&mut first)
        .arg(&mut second)
        .arg(gradient)
        .arg(&partial)
        .arg(&mut norm);
    launch.arg(&all).arg(&clip).arg(rates);
    // SAFETY: the arguments are those of the kernel, and the lengths were checked above.
    unsafe { launch.launch(threads(count))? };
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
    let all = count as u32;
    let mut launch = stream.launch_builder(&kernels.ema);
    launch.arg(target).arg(online).arg(&all).arg(&rate);
    // SAFETY: the arguments are those of the kernel, and the lengths were checked above.
    unsafe { launch.launch(threads(count))? };
    Ok(())
}
