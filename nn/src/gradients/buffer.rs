//! Memory into which fast implementations write the gradient of weights.

use crate::pool::lock;
use crate::slices::modify;
use candle_core::{Result, Tensor, bail};
use std::cell::Cell;
use std::ops::Range;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// Backward passes begun in this process; each gets the next number.
static PASSES: AtomicU64 = AtomicU64::new(0);

thread_local! {
    /// Number of this thread's backward pass; 0 outside.
    static PASS: Cell<u64> = const { Cell::new(0) };
}

/// Runs `work` as a backward pass. Returns its result and the pass's number.
pub(crate) fn backward_pass<R>(work: impl FnOnce() -> R) -> (R, u64) {
    let pass = PASSES.fetch_add(1, Ordering::Relaxed) + 1;
    let before = PASS.replace(pass);
    let result = work();
    PASS.set(before);
    (result, pass)
}

/// The gradient of one network's weights, in the same memory at each step. Candle's `GradStore`
/// would allocate these megabytes three times in each backward pass, which takes milliseconds.
#[derive(Debug)]
pub(crate) struct GradientBuffer {
    values: Tensor,
    /// Number of the last backward pass, and the ranges that it wrote.
    written: Mutex<(u64, Vec<Range<usize>>)>,
}

impl GradientBuffer {
    pub fn new(weights: &Tensor) -> Result<Self> {
        Ok(Self { values: weights.zeros_like()?.detach(), written: Mutex::default() })
    }

    /// Lets `work` write the whole gradient of a range of the weights. It is added to the same
    /// pass's gradient of this range, and replaces that of an earlier pass.
    pub fn write(&self, range: Range<usize>, work: impl FnOnce(&mut [f32])) -> Result<()> {
        let pass = PASS.get();
        if pass == 0 {
            bail!("the gradients of weights are taken by `Gradients::backward`");
        }
        let mut written = lock(&self.written);
        if written.0 != pass {
            *written = (pass, Vec::new());
        }
        if !written.1.contains(&range) {
            written.1.push(range.clone());
            return modify(&self.values, |values| work(&mut values[range]));
        }
        let mut more = vec![0.0; range.len()];
        work(&mut more);
        modify(&self.values, |values| {
            values[range].iter_mut().zip(&more).for_each(|(sum, x)| *sum += x)
        })
    }

    /// The gradient of this pass, 0 outside the written ranges; `None` if the pass wrote nothing.
    pub fn read(&self, pass: u64) -> Option<Tensor> {
        let mut written = lock(&self.written);
        if written.0 != pass {
            return None;
        }
        written.1.sort_by_key(|range| range.start);
        let cleared = modify(&self.values, |values| {
            let mut end = 0;
            for range in written.1.iter().chain([&(values.len()..0)]) {
                values[end..range.start].fill(0.0);
                end = range.end;
            }
        });
        cleared.ok().map(|()| self.values.clone())
    }
}
