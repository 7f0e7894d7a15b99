//! Memory that is used again: fresh memory of such sizes would cost as much as the arithmetic.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Values that are not in use.
#[derive(Default)]
pub(crate) struct Pool<T>(Mutex<Vec<T>>);

impl<T: Default> Pool<T> {
    /// Lends a value until the result is dropped.
    pub fn lend(self: &Arc<Self>) -> Pooled<T> {
        let value = lock(&self.0).pop().unwrap_or_default();
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
        lock(&self.value)
    }
}

impl<T: Default> Drop for Pooled<T> {
    fn drop(&mut self) {
        let value = std::mem::take(&mut *self.lock());
        lock(&self.pool.0).push(value);
    }
}
