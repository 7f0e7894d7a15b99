//! A network with its optimizer, and how both begin.

use candle_core::{Result, Tensor};
use quad_nn::{
    Adam, AdamStep, Ensemble, EnsembleShape, Gradients, Init, Layout, MlpConfig, TensorSpec,
    Weighted, Weights,
};

use super::context::Context;
use super::random::{Purpose, stream};

/// A network with its optimizer.
pub(super) struct TrainState<N> {
    pub network: N,
    pub adam: Adam,
}

impl<N: Weighted> TrainState<N> {
    /// A network whose weights decay so much in each step, relative to its rate.
    pub fn new(network: N, decay: f32) -> Result<Self> {
        Ok(Self { adam: Adam::new(network.weights(), decay)?, network })
    }

    /// Moves the network down a loss `[]`. Gives the gradient's norm before clipping, `[]`.
    pub fn minimize(&mut self, loss: &Tensor, step: AdamStep) -> Result<Tensor> {
        self.apply_gradients(&Gradients::of(loss)?, step)
    }

    /// As [`Self::minimize`], by the step that [`Adam::set`] was given.
    pub fn apply_as_set(&mut self, loss: &Tensor) -> Result<Tensor> {
        let gradient = Gradients::of(loss)?.with_respect_to(self.network.weights())?;
        self.adam.apply_as_set(self.network.weights_mut(), &gradient)
    }

    /// As [`Self::minimize`], down the loss that `gradients` are of.
    pub fn apply_gradients(&mut self, gradients: &Gradients, step: AdamStep) -> Result<Tensor> {
        let gradient = gradients.with_respect_to(self.network.weights())?;
        self.adam.apply(self.network.weights_mut(), &gradient, step)
    }
}

/// The trainable weights that network number `network` of a run begins with.
pub(super) fn initial(layout: &Layout, context: &Context, network: u64) -> Result<Weights> {
    let mut generator = stream(context.seed, Purpose::Weights, network);
    Weights::trainable(layout.clone(), &Weights::initial(layout, &mut generator, &context.device)?)
}

/// An ensemble to be trained, at its beginning.
pub(super) fn ensemble(
    shape: EnsembleShape,
    context: &Context,
    network: u64,
) -> Result<TrainState<Ensemble>> {
    let weights = initial(&shape.layout(), context, network)?;
    TrainState::new(Ensemble::new(shape, weights, context.precision), 0.0)
}

/// Learned numbers, `[n]`, under one name, that begin as these.
pub(super) fn learned(name: &str, begin: &[f32], context: &Context) -> Result<TrainState<Weights>> {
    let part =
        TensorSpec { name: name.to_owned(), shape: vec![begin.len()], start: Init::Constant(0.0) };
    let values = Tensor::from_slice(begin, begin.len(), &context.device)?;
    TrainState::new(Weights::trainable(Layout::new(vec![part]), &values)?, 0.0)
}

/// Multiplies the last layer of networks with these hidden layers by a factor.
pub(super) fn scale_last_layer(
    weights: &mut Weights,
    layers: &MlpConfig,
    factor: f64,
) -> Result<()> {
    let last = format!("{}.", layers.hidden.len());
    let of_last = weights.tensors("")?.into_iter().filter(|(name, _)| name.starts_with(&last));
    let count = of_last.map(|(_, tensor)| tensor.elem_count()).sum();
    weights.change(|values| {
        let start = values.elem_count() - count; // it lies at the end
        values.slice_set(&(values.narrow(0, start, count)? * factor)?, 0, start)
    })
}
