//! Kernels packed once, and used until the weights change.

use crate::mlp::{Kernels, Mlp};
use crate::precision::Precision;
use crate::slices::read;
use crate::weights::Weights;
use candle_core::Result;
use rayon::prelude::*;
use std::sync::{Arc, Mutex, PoisonError};

/// How the kernels of some networks are packed.
pub(crate) struct Packing {
    pub precision: Precision,
    /// Whether the weights stay. In f32, packing kernels for one gradient step costs as much as it gains.
    pub fixed: bool,
    /// What was made of the weights, and of which state of them.
    made: Mutex<Option<(u64, Arc<Kernels>)>>,
}

impl Packing {
    /// For weights that change.
    pub fn new(precision: Precision) -> Self {
        Self { precision, fixed: false, made: Mutex::default() }
    }

    /// The kernels of these networks, packed now or before; `None` if they are not to be packed.
    pub fn kernels(&self, mlp: &Mlp, weights: &Weights) -> Result<Option<Arc<Kernels>>> {
        if self.precision == Precision::F32 && !self.fixed {
            return Ok(None);
        }
        let mut made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((changes, kernels)) = &*made
            && *changes == weights.changes()
        {
            return Ok(Some(kernels.clone()));
        }
        let pack = |weights: &[f32]| {
            let members = (0..mlp.layers.members).into_par_iter();
            members.filter_map(|member| mlp.network(weights, member).pack(self.precision)).collect::<Kernels>()
        };
        let kernels = Arc::new(read(weights.values(), pack)?);
        *made = Some((weights.changes(), kernels.clone()));
        Ok(Some(kernels))
    }
}
