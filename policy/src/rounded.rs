//! Kernels rounded once, and used until the weights change.

use crate::mlp::{Kernels, Mlp};
use crate::precision::Precision;
use crate::slices::read;
use crate::weights::Weights;
use candle_core::Result;
use rayon::prelude::*;
use std::sync::{Arc, Mutex, PoisonError};

/// How the products of some networks are rounded.
pub(crate) struct Rounding {
    pub precision: Precision,
    /// What was made of the weights, and of which state of them.
    made: Mutex<Option<(u64, Arc<Kernels>)>>,
}

impl Rounding {
    pub fn new(precision: Precision) -> Self {
        Self { precision, made: Mutex::default() }
    }

    /// The kernels of these networks, made now or before; `None` if they are not to be rounded.
    pub fn kernels(&self, mlp: &Mlp, weights: &Weights) -> Result<Option<Arc<Kernels>>> {
        if self.precision == Precision::F32 {
            return Ok(None);
        }
        let mut made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((changes, kernels)) = &*made
            && *changes == weights.changes()
        {
            return Ok(Some(kernels.clone()));
        }
        let round = |weights: &[f32]| {
            let members = (0..mlp.layers.members).into_par_iter();
            members.filter_map(|member| mlp.network(weights, member).round()).collect::<Kernels>()
        };
        let kernels = Arc::new(read(weights.values(), round)?);
        *made = Some((weights.changes(), kernels.clone()));
        Ok(Some(kernels))
    }
}
