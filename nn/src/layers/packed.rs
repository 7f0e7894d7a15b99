//! Kernels packed once and used until the weights change.

use crate::layers::mlp::{Kernels, Mlp};
use crate::slices::read;
use crate::weights::Weights;
use candle_core::Result;
use rayon::prelude::*;
use std::sync::{Arc, OnceLock};

#[derive(Default)]
pub(crate) struct Packing {
    /// Set without waiting for another thread: a thread that waits in rayon for its own packing can
    /// start another call of the same policy, which must not wait for the first.
    kernels: OnceLock<Arc<Kernels>>,
}

impl Packing {
    /// Packs all kernels, on this thread alone: a process that loads a policy may fork before it
    /// acts, and its child would lack rayon's threads.
    pub fn pack(&self, mlp: &Mlp, weights: &Weights) -> Result<()> {
        if mlp.is_fast(weights) {
            let pack = |weights: &[f32]| {
                (0..mlp.layers.members).filter_map(|i| mlp.network(weights, i).pack()).collect()
            };
            self.kernels.set(Arc::new(read(weights.values(), pack)?)).ok();
        }
        Ok(())
    }

    /// The packed kernels. Rounded kernels are packed when first needed; in f32, packing for one
    /// gradient step costs as much as it gains.
    pub fn kernels(&self, mlp: &Mlp, weights: &Weights) -> Result<Option<Arc<Kernels>>> {
        if self.kernels.get().is_none() && mlp.layers.is_rounded() {
            let members = (0..mlp.layers.members).into_par_iter();
            let pack =
                |weights: &[f32]| members.filter_map(|i| mlp.network(weights, i).pack()).collect();
            self.kernels.set(Arc::new(read(weights.values(), pack)?)).ok();
        }
        Ok(self.kernels.get().cloned())
    }
}
