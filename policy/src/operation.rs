//! Custom operations of candle's in terms of slices.

use crate::slices::{on_cpu, slice};
use candle_core::{CpuStorage, CustomOp3, Error, Layout, Result, Shape, Tensor};

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

/// An operation of (weights, observations, actions) on the CPU. Gradients flow to the weights alone; they are left where
/// these keep them, rather than returned.
pub(crate) trait Operation: Send + Sync {
    const NAME: &'static str;

    /// The outcome and its shape.
    fn forward(&self, arguments: Arguments<'_>) -> Result<(Vec<f32>, Shape)>;

    /// The backward pass, from the gradient of the outcome.
    fn backward(&self, _arguments: Arguments<'_>, _gradient: &[f32]) -> Result<()> {
        Err(Error::BackwardNotSupported { op: Self::NAME })
    }
}

/// An [`Operation`] as candle wants it.
pub(crate) struct OnCpu<O>(pub O);

fn arguments<'a>(numbers: [&'a [f32]; 3], observations: &[usize], actions: &[usize]) -> Result<Arguments<'a>> {
    let [weights, in_observations, in_actions] = numbers;
    let (&[states, _], [.., rows, _]) = (observations, actions) else {
        candle_core::bail!("observations of shape {observations:?} and actions of shape {actions:?} are no rows")
    };
    Ok(Arguments { weights, observations: in_observations, actions: in_actions, states, rows: *rows })
}

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
        let numbers = [
            slice(weights, weights_layout)?,
            slice(observations, observations_layout)?,
            slice(actions, actions_layout)?,
        ];
        let (out, shape) = self.0.forward(arguments(numbers, observations_layout.dims(), actions_layout.dims())?)?;
        Ok((CpuStorage::F32(out), shape))
    }

    fn bwd(
        &self,
        weights: &Tensor,
        observations: &Tensor,
        actions: &Tensor,
        _outcome: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let gradient = gradient.contiguous()?;
        let held = [weights, observations, actions, &gradient].map(Tensor::storage_and_layout);
        let [w, s, a, g] = held.each_ref().map(|(storage, layout)| on_cpu(storage, layout));
        self.0.backward(arguments([w?, s?, a?], observations.dims(), actions.dims())?, g?)?;
        Ok((None, None, None))
    }
}
