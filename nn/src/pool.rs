//! Memory that is used again: fresh memory of such sizes would cost as much as the arithmetic.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Values that are not in use.
#[derive(Default)]
pub(crate) struct Pool<T>(Mutex<Vec<T>>);

impl<T: Default> Pool<T> {
    /// Lends a value until the result is dropped.
    pub fn lend(self: &Arc<Self>) -> Pooled<T> {
        let value = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default();
        Pooled { value: Mutex::new(value), pool: self.clone() }
    }
}

/// A value of a pool, to which it returns.
pub(crate) struct Pooled<T: Default> {
    value: Mutex<T>,
    pool: Arc<Pool<T>>,
}

impl<T: Default> Pooled<T> {
    pub fn lock(&self) -> MutexGuard<'_, T> {
        self.value.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T: Default> Drop for Pooled<T> {
    fn drop(&mut self) {
        let value = std::mem::take(self.value.get_mut().unwrap_or_else(PoisonError::into_inner));
        self.pool.0.lock().unwrap_or_else(PoisonError::into_inner).push(value);
    }
}
