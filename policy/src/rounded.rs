//! What is prepared once from weights and used until they change.

use crate::slices::read;
use crate::weights::Weights;
use candle_core::Result;
use std::sync::{Arc, Mutex, PoisonError};

/// Something made of weights, and of which state of them.
type Made<T> = Option<(u64, Arc<T>)>;

/// Kernels with their numbers rounded, made anew when the weights have changed.
pub(crate) struct RoundedOnce<T>(Mutex<Made<T>>);

impl<T> Default for RoundedOnce<T> {
    fn default() -> Self {
        Self(Mutex::new(None))
    }
}

impl<T> RoundedOnce<T> {
    /// What `make` makes of these weights, or made before.
    pub fn get(&self, weights: &Weights, make: impl FnOnce(&[f32]) -> T) -> Result<Arc<T>> {
        let mut made = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((changes, rounded)) = &*made
            && *changes == weights.changes()
        {
            return Ok(rounded.clone());
        }
        let rounded = Arc::new(read(weights.values(), make)?);
        *made = Some((weights.changes(), rounded.clone()));
        Ok(rounded)
    }
}
