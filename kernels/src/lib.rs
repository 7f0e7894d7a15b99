//! Arithmetic on slices that candle's own CPU code is too slow for. All assembly and `unsafe` of
//! the networks is here.
//!
//! # Layout
//!
//! - [`product`]: dense products on one thread, in f32 and with operands rounded to bfloat16.
//! - `packed`: a product's right-hand side, laid out once for many products.
//! - `avx512`, `avx2`: the products that the libraries at hand do more slowly
//!   (kernels/benches/README.md says by how much).
//! - [`activation`]: Mish and its derivative; [`narrow`]: the first and last layer of a network,
//!   fused with it.
//! - [`norm`]: layer norm, forward and backward.
//! - [`optimizer`]: Adam and EMA over whole parameter vectors.
//! - `cuda`: what of this a GPU does in one launch, and `recording`: many launches as one; both
//!   with the feature `cuda`.
//! - [`scaling`]: between a user's units and those of networks.
//! - [`Level`] (`level`): which of the CPU's instructions are used.
//! - [`Buffer`] (`buffer`): memory that is used again and again, aligned to cache lines.
//! - `vectorized`: the macro that loops are written with.
//!
//! Matrices are row-major `f32` slices; a name's shape is given as `rows × columns`. What a CPU can
//! do is found out at run time.

pub mod activation;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod buffer;
#[cfg(feature = "cuda")]
pub mod cuda;
mod level;
pub mod narrow;
pub mod norm;
pub mod optimizer;
#[cfg(target_arch = "x86_64")]
mod packed;
pub mod product;
#[cfg(feature = "cuda")]
pub mod recording;
pub mod scaling;
mod vectorized;

pub use buffer::Buffer;
pub use level::Level;
