//! Arithmetic on slices that candle's own CPU code is too slow for. All assembly and `unsafe` of
//! the networks is here.
//!
//! # Layout
//!
//! - [`product`]: dense products on one thread, in f32 and in bfloat16 ([`Precision`]); `packed`:
//!   their right-hand sides, packed once; `avx512`, `avx2`: products faster than a library's
//!   (kernels/benches/README.md).
//! - [`activation`]: activations and their derivatives; [`narrow`]: the first and last layer of a
//!   network; [`norm`]: layer norm, forward and backward.
//! - [`optimizer`]: Adam and EMA over whole parameter vectors.
//! - `cuda`, `cuda_mlp`, `cuda_graph` (feature `cuda`): loops on a GPU, whole networks, and many
//!   launches as one; `cuda_kernels` translates their source.
//! - [`scaling`]: conversion between a user's units and those of networks.
//! - [`Level`] (`level`): the CPU's instructions in use; `vectorized`: a macro that compiles loops
//!   for each level; [`Buffer`] (`buffer`): reused memory, aligned to cache lines.
//!
//! Matrices are row-major `f32` slices; their shapes are given as `rows × columns`.

pub mod activation;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod buffer;
#[cfg(feature = "cuda")]
pub mod cuda;
#[cfg(feature = "cuda")]
pub mod cuda_graph;
#[cfg(feature = "cuda")]
pub mod cuda_kernels;
#[cfg(feature = "cuda")]
pub mod cuda_mlp;
mod level;
pub mod narrow;
pub mod norm;
pub mod optimizer;
#[cfg(target_arch = "x86_64")]
mod packed;
mod precision;
pub mod product;
pub mod scaling;
mod vectorized;

pub use buffer::Buffer;
pub use level::Level;
pub use precision::Precision;
