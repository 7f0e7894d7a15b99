//! Losses with the scalars that are measured along with them, and reductions that keep NaN.

use candle_core::{Result, Tensor};
use quad_nn::mean_and_variance;
use quad_policy::Aggregate;

/// Metrics of an update by the names in the algorithm's table.
pub type Measured = Vec<(&'static str, f32)>;

/// The smallest of the critics' values, `[K, B]` → `[B]`. (`min` ignores NaN; adding 0·sum keeps
/// it.)
pub(super) fn smallest(values: &Tensor) -> Result<Tensor> {
    values.min(0)? + (values.sum(0)? * 0.0)?
}

/// The largest value along a dimension, which it removes. (`max` ignores NaN; adding 0·sum keeps
/// it.)
pub(super) fn largest(values: &Tensor, dimension: usize) -> Result<Tensor> {
    values.max(dimension)? + (values.sum(dimension)? * 0.0)?
}

/// The mean − κ·standard deviation over the critics of constant values, `[K, B]` → `[B]`. The
/// variance is divided by K, as in [`Aggregate::MeanMinusStd`].
pub(super) fn lower_bound(values: &Tensor, kappa: f32) -> Result<Tensor> {
    let (mean, variance) = mean_and_variance(values)?;
    mean - (variance.sqrt()? * f64::from(kappa))?
}

/// The aggregate of the critics' values, which are constants, `[K, B]` → `[B]`.
pub(super) fn reduced(values: &Tensor, aggregate: Aggregate) -> Result<Tensor> {
    match aggregate {
        Aggregate::Mean => values.mean(0),
        Aggregate::Min => smallest(values),
        Aggregate::MeanMinusStd(kappa) => lower_bound(values, kappa),
    }
}

/// A loss `[]`, and the scalars `[]` that are measured with it.
pub(super) struct Loss {
    pub value: Tensor,
    /// By name of metric, the loss first.
    pub scalars: Vec<(&'static str, Tensor)>,
    /// Tensors of any shape from which metrics are computed on the CPU.
    pub metric_inputs: Vec<Tensor>,
}

impl Loss {
    /// A loss that is the metric of this name.
    pub fn new(name: &'static str, value: Tensor) -> Self {
        let (scalars, metric_inputs) = (vec![(name, value.clone())], Vec::new());
        Self { value, scalars, metric_inputs }
    }

    /// The critics' loss, and the mean of their targets y `[B]`.
    pub fn critics(value: Tensor, targets: &Tensor) -> Result<Self> {
        Ok(Self::new("critic_loss", value).with("target_q_mean", targets.mean_all()?))
    }

    /// Adds a scalar `[]` or `[1]`, if there is one.
    pub fn with(mut self, name: &'static str, scalar: impl Into<Option<Tensor>>) -> Self {
        self.scalars.extend(scalar.into().map(|scalar| (name, scalar)));
        self
    }
}

/// The numbers of an update's metrics on their device.
pub(super) struct Computed {
    names: Vec<&'static str>,
    /// The scalars, then the inputs of metrics, `[n]`.
    pub numbers: Tensor,
}

impl Computed {
    pub fn new(losses: &[Loss]) -> Result<Self> {
        let scalars = || losses.iter().flat_map(|loss| &loss.scalars);
        let inputs = losses.iter().flat_map(|loss| &loss.metric_inputs);
        let numbers = joined(scalars().map(|(_, scalar)| scalar).chain(inputs))?;
        let names = scalars().map(|(name, _)| *name).collect();
        Ok(Self { names, numbers })
    }

    /// Copies the scalars by name and the inputs of metrics, once they are computed.
    pub fn read(&self) -> Result<(Measured, Vec<f32>)> {
        let mut scalars = self.numbers.to_vec1()?;
        let inputs = scalars.split_off(self.names.len());
        let names = self.names.iter().copied();
        Ok((names.zip(scalars).collect(), inputs))
    }
}

pub(super) fn measured(losses: &[Loss]) -> Result<Measured> {
    Ok(Computed::new(losses)?.read()?.0)
}

/// The numbers of some tensors, one tensor after the other, `[n]`.
pub(super) fn joined<'a>(tensors: impl IntoIterator<Item = &'a Tensor>) -> Result<Tensor> {
    let vectors = tensors.into_iter().map(Tensor::flatten_all);
    Tensor::cat(&vectors.collect::<Result<Vec<_>>>()?, 0)
}
