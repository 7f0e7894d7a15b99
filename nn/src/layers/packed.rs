//! Kernels packed once, and used until the weights change.

use crate::layers::mlp::{Kernels, Mlp};
use crate::precision::Precision;
use crate::slices::read;
use crate::weights::Weights;
use candle_core::Result;
use rayon::prelude::*;
use std::sync::{Arc, OnceLock};

/// The packed kernels of some networks.
pub(crate) struct Packing {
    pub precision: Precision,
    /// Set without waiting for another thread: a thread that waits in rayon for a part of its own
    /// packing may take up another call of the same policy, which must not wait for the first.
    made: OnceLock<Arc<Kernels>>,
}

impl Packing {
    /// Nothing is packed yet.
    pub fn new(precision: Precision) -> Self {
        Self { precision, made: OnceLock::new() }
    }

    /// Packs all kernels, on this thread alone: a process that loads a policy may fork before it
    /// acts, and its child would lack rayon's threads.
    pub fn pack(&self, mlp: &Mlp, weights: &Weights) -> Result<()> {
        if mlp.is_fast(weights) {
            let members = 0..mlp.layers.members;
            let pack = |weights: &[f32]| {
                members.filter_map(|i| mlp.network(weights, i).pack(self.precision)).collect()
            };
            self.made.set(Arc::new(read(weights.values(), pack)?)).ok();
        }
        Ok(())
    }

    /// The packed kernels of these networks, if there are any. Rounded kernels are made when they
    /// are first needed. In f32, packing kernels for one gradient step costs as much as it gains.
    pub fn kernels(&self, mlp: &Mlp, weights: &Weights) -> Result<Option<Arc<Kernels>>> {
        if self.made.get().is_none() && self.precision == Precision::Bf16 {
            let members = (0..mlp.layers.members).into_par_iter();
            let pack = |weights: &[f32]| {
                members.filter_map(|i| mlp.network(weights, i).pack(self.precision)).collect()
            };
            self.made.set(Arc::new(read(weights.values(), pack)?)).ok();
        }
        Ok(self.made.get().cloned())
    }
}
