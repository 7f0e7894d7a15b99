//! A network with its optimizer, and how both begin.

use candle_core::{Result, Tensor};
use quad_policy::{
    Adam, AdamStep, Ensemble, EnsembleShape, Gradients, Layout, MlpConfig, Part, Start, Weighted,
    Weights,
};

use super::context::Context;
use super::random::{Purpose, stream};

/// A network with its optimizer.
pub(super) struct Trained<N> {
    pub network: N,
    pub adam: Adam,
}

impl<N: Weighted> Trained<N> {
    /// A network whose weights decay so much in each step, relative to its rate.
    pub fn new(network: N, decay: f32) -> Result<Self> {
        Ok(Self { adam: Adam::new(network.weights(), decay)?, network })
    }

    /// Moves the network down a loss `[]`. Gives the gradient's norm before clipping, `[]`.
    pub fn descend(&mut self, loss: &Tensor, step: AdamStep) -> Result<Tensor> {
        self.descend_along(&Gradients::of(loss)?, step)
    }

    /// As [`Self::descend`], by the step that [`Adam::set`] was given.
    pub fn descend_as_set(&mut self, loss: &Tensor) -> Result<Tensor> {
        let gradient = Gradients::of(loss)?.with_respect_to(self.network.weights())?;
        self.adam.descend_as_set(self.network.weights_mut(), &gradient)
    }

    /// As [`Self::descend`], down the loss that `gradients` are of.
    pub fn descend_along(&mut self, gradients: &Gradients, step: AdamStep) -> Result<Tensor> {
        let gradient = gradients.with_respect_to(self.network.weights())?;
        self.adam.descend(self.network.weights_mut(), &gradient, step)
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
) -> Result<Trained<Ensemble>> {
    let weights = initial(&shape.layout(), context, network)?;
    Trained::new(Ensemble::new(shape, weights, context.precision), 0.0)
}

/// Learned numbers, `[n]`, under one name, that begin as these.
pub(super) fn learned(name: &str, begin: &[f32], context: &Context) -> Result<Trained<Weights>> {
    let part =
        Part { name: name.to_owned(), shape: vec![begin.len()], start: Start::Constant(0.0) };
    let values = Tensor::from_slice(begin, begin.len(), &context.device)?;
    Trained::new(Weights::trainable(Layout::new(vec![part]), &values)?, 0.0)
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
