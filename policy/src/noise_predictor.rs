//! The noise predictor ε_θ(a^t, s, t) and the sampler that denoises with it.
//!
//! On the CPU custom operations of candle's do the work (`noise_ops`); elsewhere plain ones do.

use crate::noise_ops::{Parts, Predict, Sample};
use crate::operation::OnCpu;
use crate::plain;
use crate::precision::Precision;
use crate::rounded::RoundedOnce;
use crate::saved::{Pool, SavedActivations};
use crate::schedule::Schedule;
use crate::shape::{NoiseShape, TIME_FEATURES};
use crate::slices::{has_fast_body, read};
use crate::weights::{Tensors, Weights};
use candle_core::{D, DType, Result, Tensor};
use quad_kernels::product::Rounded;
use std::sync::{Arc, OnceLock};

/// A noise predictor and its weights.
pub struct NoisePredictor {
    parts: Arc<Parts>,
    weights: Weights,
    precision: Precision,
    rounded: RoundedOnce<Option<[Rounded; 2]>>,
    saved: Pool<SavedActivations>,
}

/// cos(t·f_k), then sin(t·f_k), with f_k = exp(-k·ln(10000)/7) for k = 0..7, of t = 1..T.
fn time_features(steps: usize) -> Vec<f32> {
    let half = TIME_FEATURES / 2;
    let angle = |t: usize, k: usize| t as f64 * (-(k as f64) * 10_000_f64.ln() / (half - 1) as f64).exp();
    let row = |t| (0..half).map(move |k| angle(t, k).cos()).chain((0..half).map(move |k| angle(t, k).sin()));
    (1..=steps).flat_map(row).map(|x| x as f32).collect()
}

impl NoisePredictor {
    /// `weights` are of the shape's layout; `precision` is for what no gradient is taken of.
    pub fn new(shape: NoiseShape, weights: Weights, precision: Precision) -> Self {
        let parts = Parts {
            shape,
            time: shape.time_layers(),
            trunk: shape.trunk_layers(),
            schedule: Schedule::variance_preserving(shape.diffusion_steps),
            features: time_features(shape.diffusion_steps),
        };
        let (rounded, saved) = (RoundedOnce::default(), Pool::default());
        Self { parts: Arc::new(parts), weights, precision, rounded, saved }
    }

    /// Its weights.
    pub fn weights(&self) -> &Weights {
        &self.weights
    }

    /// Its weights, to be changed.
    pub fn weights_mut(&mut self) -> &mut Weights {
        &mut self.weights
    }

    /// Its shape.
    pub fn shape(&self) -> NoiseShape {
        self.parts.shape
    }

    /// The noise schedule that it was made for.
    pub fn schedule(&self) -> &Schedule {
        &self.parts.schedule
    }

    /// ε_θ(a^t, s, t): `observations [B, o]`, `actions [B, a]`, `t [B]` (u32, in 1..=T) → `[B, a]`. Gradients flow to the
    /// weights.
    pub fn predict(&self, observations: &Tensor, actions: &Tensor, t: &Tensor) -> Result<Tensor> {
        let weights = self.weights.values();
        if !has_fast_body(weights.device()) || observations.track_op() || actions.track_op() {
            return self.plain_predict(observations, actions, t);
        }
        let gradient = match (weights.track_op(), self.weights.kept_gradient()) {
            (true, Some(kept)) => Some((kept, self.saved.lend())),
            _ => None,
        };
        let operation = OnCpu(Predict {
            parts: self.parts.clone(),
            t: read(t, <[u32]>::to_vec)?,
            gradient,
            embedding: OnceLock::new(),
        });
        weights.apply_op3(&observations.contiguous()?, &actions.contiguous()?, operation)
    }

    /// The same network with its weights as constants, which share their memory with these.
    pub fn frozen(&self) -> Self {
        let (parts, weights) = (self.parts.clone(), self.weights.frozen());
        Self { parts, weights, precision: Precision::F32, rounded: RoundedOnce::default(), saved: Pool::default() }
    }

    /// Draws actions by the whole reverse process (DDPM), x_0 clipped to [-1, 1] at each step.
    ///
    /// `observations` is `[n, o]`; `noise` is `[T, rows, a]`, standard normal, where equally many consecutive rows share an
    /// observation: first a^T, then the noise of the reverse steps from t = T down to 2. Gives `[rows, a]`, through which no
    /// gradient flows.
    pub fn sample(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        let weights = self.weights.values().detach();
        if !has_fast_body(weights.device()) {
            return self.plain_sample(observations, noise);
        }
        let rounded = match self.precision {
            Precision::F32 => None,
            Precision::Bf16 => Some(self.rounded.get(&self.weights, |weights| self.parts.network(weights).round())?),
        };
        let operation = OnCpu(Sample { parts: self.parts.clone(), rounded });
        weights.apply_op3_no_bwd(&observations.contiguous()?, &noise.contiguous()?, &operation)
    }

    /// [`Self::predict`] in plain candle operations.
    pub(crate) fn plain_predict(&self, observations: &Tensor, actions: &Tensor, t: &Tensor) -> Result<Tensor> {
        let weights = self.weights.layout().split(self.weights.values(), "")?;
        self.plain_predict_with(&weights, observations, actions, t)
    }

    fn plain_predict_with(
        &self,
        weights: &Tensors,
        observations: &Tensor,
        actions: &Tensor,
        t: &Tensor,
    ) -> Result<Tensor> {
        let steps = self.parts.shape.diffusion_steps;
        let features = Tensor::from_slice(&self.parts.features, (steps, TIME_FEATURES), t.device())?;
        let embedding = plain::mlp(weights, "time.", 2, &features)?;
        let time = embedding.index_select(&(t.to_dtype(DType::F32)? - 1.0)?.to_dtype(DType::U32)?, 0)?;
        plain::mlp(weights, "trunk.", 4, &Tensor::cat(&[observations, actions, &time], D::Minus1)?)
    }

    /// [`Self::sample`] in plain candle operations.
    pub(crate) fn plain_sample(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        let weights = self.weights.layout().split(&self.weights.values().detach(), "")?;
        let (steps, rows, _) = noise.dims3()?;
        let observations = plain::repeat_rows(observations, rows / observations.dim(0)?)?;
        let mut actions = noise.get(0)?;
        for t in (1..=steps).rev() {
            let all = Tensor::full(t as u32, rows, noise.device())?;
            let epsilon = self.plain_predict_with(&weights, &observations, &actions, &all)?;
            let z = if t > 1 { Some(noise.get(steps - t + 1)?) } else { None };
            actions = self.schedule().reverse(t, &actions, &epsilon, z.as_ref())?;
        }
        Ok(actions)
    }
}
