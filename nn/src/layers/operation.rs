//! Custom operations of candle's in terms of slices.

use crate::slices::slice;
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape};

/// What an operation on the CPU is given: numbers and shapes of its three arguments.
#[derive(Clone, Copy)]
pub(crate) struct Arguments<'a> {
    pub weights: &'a [f32],
    pub observations: &'a [f32],
    /// Actions, or for the sampler noise.
    pub actions: &'a [f32],
    /// Observations.
    pub states: usize,
    /// Rows of actions.
    pub rows: usize,
}

/// An operation of (weights, observations, actions) on the CPU, through which no gradient flows.
pub(crate) trait Operation: Send + Sync {
    const NAME: &'static str;

    /// The outcome and its shape.
    fn forward(&self, arguments: Arguments<'_>) -> Result<(Vec<f32>, Shape)>;
}

/// An [`Operation`] as candle wants it.
pub(crate) struct OnCpu<O>(pub O);

impl<O: Operation> CustomOp3 for OnCpu<O> {
    fn name(&self) -> &'static str {
        O::NAME
    }

    fn cpu_fwd(
        &self,
        weights: &CpuStorage,
        weights_layout: &Layout,
        observations: &CpuStorage,
        observations_layout: &Layout,
        actions: &CpuStorage,
        actions_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (&[states, _], &[.., rows, _]) = (observations_layout.dims(), actions_layout.dims())
        else {
            candle_core::bail!(
                "{} of {observations_layout:?} and {actions_layout:?}, which are no rows",
                O::NAME
            )
        };
        let (out, shape) = self.0.forward(Arguments {
            weights: slice(weights, weights_layout)?,
            observations: slice(observations, observations_layout)?,
            actions: slice(actions, actions_layout)?,
            states,
            rows,
        })?;
        Ok((CpuStorage::F32(out), shape))
    }
}
