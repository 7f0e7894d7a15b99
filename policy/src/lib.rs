//! What the weights mean.
mod architecture;
pub use architecture::Architecture;
