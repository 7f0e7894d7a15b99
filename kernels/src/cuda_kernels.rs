//! The kernels of `cuda.cu` and `mlp.cu`, which the driver's compiler translates for the GPU at hand
//! when the first is launched.

use cudarc::driver::sys::{
    CUdevice_attribute as Attribute, CUfunction_attribute_enum as FunctionAttribute,
};
use cudarc::driver::{CudaFunction, CudaModule, CudaStream, DriverError};
use cudarc::nvrtc::{CompileError, CompileOptions, compile_ptx_with_opts};
use std::sync::{Arc, Mutex, PoisonError};

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

/// The kernels for tiles of this many rows.
pub(crate) struct Tiles {
    pub rows: u32,
    pub forward: CudaFunction,
    pub sample: CudaFunction,
    pub backward: CudaFunction,
    pub gradients: CudaFunction,
}

/// The compiled kernels.
pub(crate) struct Kernels {
    pub squares: CudaFunction,
    pub adam: CudaFunction,
    pub ema: CudaFunction,
    pub squared_error: CudaFunction,
    pub squared_error_gradient: CudaFunction,
    pub guide: CudaFunction,
    /// From few rows to many.
    tiles: [Tiles; 3],
    /// Multiprocessors of the GPU.
    processors: u32,
}

impl Kernels {
    /// The smallest tiles that the GPU computes all at once, or else the largest.
    pub fn tiles(&self, rows: usize, members: u32) -> &Tiles {
        let [small, medium, large] = &self.tiles;
        let fits = |tiles: &Tiles| (rows as u32).div_ceil(tiles.rows) * members <= self.processors;
        [small, medium].into_iter().find(|tiles| fits(tiles)).unwrap_or(large)
    }
}

/// The kernels, compiled by the first call. A process trains on one GPU.
pub(crate) fn kernels(stream: &CudaStream) -> Result<Arc<Kernels>> {
    static KERNELS: Mutex<Option<Arc<Kernels>>> = Mutex::new(None);
    let mut kernels = KERNELS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(kernels) = &*kernels {
        return Ok(kernels.clone());
    }
    let context = stream.context();
    let compile = |rows: u32| -> Result<Arc<CudaModule>> {
        // Tensor cores that multiply TF32 came with this one.
        let arch = Some("compute_80");
        let options = vec![format!("-DROWS={rows}")];
        let source = concat!(include_str!("cuda.cu"), include_str!("mlp.cu"));
        let options = CompileOptions { arch, options, ..CompileOptions::default() };
        Ok(context.load_module(compile_ptx_with_opts(source, options)?)?)
    };
    let memory =
        context.attribute(Attribute::CU_DEVICE_ATTRIBUTE_MAX_SHARED_MEMORY_PER_BLOCK_OPTIN)?;
    let tiles = |module: &Arc<CudaModule>, rows| -> Result<Tiles> {
        let load = |name| -> Result<CudaFunction> {
            let function = module.load_function(name)?;
            let attribute = FunctionAttribute::CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES;
            function.set_attribute(attribute, memory)?;
            Ok(function)
        };
        let [forward, sample] = [load("forward")?, load("sample")?];
        Ok(Tiles {
            rows,
            forward,
            sample,
            backward: load("backward")?,
            gradients: load("gradients")?,
        })
    };
    let (module, medium, large) = (compile(8)?, compile(24)?, compile(32)?);
    let compiled = Kernels {
        squares: module.load_function("squares")?,
        adam: module.load_function("adam")?,
        ema: module.load_function("ema")?,
        squared_error: module.load_function("squared_error")?,
        squared_error_gradient: module.load_function("squared_error_gradient")?,
        guide: module.load_function("guide")?,
        tiles: [tiles(&module, 8)?, tiles(&medium, 24)?, tiles(&large, 32)?],
        processors: context.attribute(Attribute::CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT)? as u32,
    };
    Ok(kernels.insert(Arc::new(compiled)).clone())
}
