//! The noise predictor ε_θ(a^t, s, t) and its sampler.

use crate::diffusion::sampler::Architecture;
use crate::diffusion::schedule::Schedule;
use crate::layers::mlp::Mlp;
use crate::layers::packed::Packing;
use crate::layers::plain;
use crate::shape::{NoiseShape, TIME_FEATURES};
use crate::slices::read_all;
use crate::weighted::weighted;
use crate::weights::Weights;
use candle_core::{Result, Tensor, bail};
use quad_kernels::Precision;
use std::sync::{Arc, OnceLock};

/// A noise predictor and its weights.
pub struct NoisePredictor {
    architecture: Arc<Architecture>,
    weights: Weights,
    packing: Packing,
}

/// cos(x·f_k), then sin(x·f_k), with f_k = exp(-k·ln(10000)/7) for k = 0..7.
pub(crate) fn sinusoids(x: f64) -> impl Iterator<Item = f32> {
    let half = TIME_FEATURES / 2;
    let angle = move |k: usize| x * (-(k as f64) * 10_000_f64.ln() / (half - 1) as f64).exp();
    (0..half)
        .map(move |k| angle(k).cos())
        .chain((0..half).map(move |k| angle(k).sin()))
        .map(|x| x as f32)
}

weighted!(NoisePredictor, architecture.trunk);

impl NoisePredictor {
    /// A noise predictor with weights of the shape's layout, whose products are in this precision.
    pub fn new(shape: NoiseShape, weights: Weights, precision: Precision) -> Self {
        let architecture = Architecture {
            time: Mlp::new(shape.time_layers(), "time."),
            trunk: Mlp::new(shape.trunk_layers().with_precision(precision), "trunk."),
            schedule: Schedule::new(shape.diffusion_steps, shape.reverse),
            features: (0..=shape.diffusion_steps).flat_map(|t| sinusoids(t as f64)).collect(),
            features_tensor: OnceLock::new(),
            #[cfg(feature = "cuda")]
            steps_tensor: OnceLock::new(),
            shape,
        };
        Self::with_weights(Arc::new(architecture), weights)
    }

    fn with_weights(architecture: Arc<Architecture>, weights: Weights) -> Self {
        let packing = Packing::default();
        Self { architecture, weights, packing }
    }

    /// Sizes and hidden layers.
    pub fn shape(&self) -> &NoiseShape {
        &self.architecture.shape
    }

    /// The noise schedule.
    pub fn schedule(&self) -> &Schedule {
        &self.architecture.schedule
    }

    /// The sinusoids of t = 0..T, `[1 + T, 16]`, on the weights' device.
    fn features(&self) -> Result<Tensor> {
        let made = &self.architecture.features_tensor;
        if let Some(tensor) = made.get() {
            return Ok(tensor.clone());
        }
        let (features, device) = (&self.architecture.features, self.weights.values().device());
        let tensor = Tensor::from_slice(features, ((), TIME_FEATURES), device)?;
        Ok(made.get_or_init(|| tensor).clone())
    }

    fn embed(&self, features: &Tensor) -> Result<Tensor> {
        let embedding = self.architecture.time.forward(&self.weights, &[features]);
        embedding?.squeeze(0)
    }

    /// The embeddings of t = 1..T, `[T, 32]`.
    fn embeddings(&self) -> Result<Tensor> {
        let steps = self.architecture.shape.diffusion_steps;
        self.embed(&self.features()?.narrow(0, 1, steps)?)
    }

    /// The coefficients of all reverse steps, `[T, 7]`, on the weights' device.
    #[cfg(feature = "cuda")]
    fn reverse_steps(&self) -> Result<Tensor> {
        let made = &self.architecture.steps_tensor;
        if let Some(tensor) = made.get() {
            return Ok(tensor.clone());
        }
        let (steps, device) = (self.schedule().reverse_steps(), self.weights.values().device());
        let tensor = Tensor::from_vec(steps, ((), 7), device)?;
        Ok(made.get_or_init(|| tensor).clone())
    }

    /// ε_θ(a^t, s, t): `observations [B, o]`, `actions [B, a]`, `t [B]` (u32, in 1..=T) → `[B, a]`.
    /// Differentiable in weights, observations and actions.
    pub fn predict(&self, observations: &Tensor, actions: &Tensor, t: &Tensor) -> Result<Tensor> {
        let trunk = &self.architecture.trunk;
        // A GPU sooner embeds every row than it adds up the rows' gradients.
        let embedding = match t.device().is_cuda() {
            true => self.embed(&self.features()?.index_select(t, 0)?)?,
            false => self.embeddings()?.index_select(&(t - t.ones_like()?)?, 0)?,
        };
        trunk.forward(&self.weights, &[observations, actions, &embedding])?.squeeze(0)
    }

    /// The same network with constant weights, in the same memory.
    pub fn detach(&self) -> Self {
        Self::with_weights(self.architecture.clone(), self.weights.detach())
    }

    /// Draws actions `[rows, a]` by the reverse process (DDPM), without gradients.
    ///
    /// `observations` is `[n, o]`; `noise` is `[T, rows, a]`, standard normal: first a^T, then the
    /// noise of the reverse steps from t = T down to 2. The first rows/n rows belong to the first
    /// observation, and so on.
    pub fn sample(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        let trunk = &self.architecture.trunk;
        if !trunk.is_fast(&self.weights) {
            return self.detach().composed_sample(observations, noise);
        }
        self.check_noise(observations, noise)?;
        let packed = self.packing.kernels(trunk, &self.weights)?;
        let (observations, noise) = (observations.contiguous()?, noise.contiguous()?);
        let (states, (_, rows, a)) = (observations.dim(0)?, noise.dims3()?);
        let actions = read_all(
            [self.weights.values(), &observations, &noise],
            |[weights, observations, noise]| {
                let inputs = (observations, states);
                self.architecture.sample(weights, packed.as_deref(), inputs, noise)
            },
        )?;
        Tensor::from_vec(actions, (rows, a), noise.device())
    }

    /// [`Self::sample`] in composed operations, with the embeddings of all t computed once.
    fn composed_sample(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        self.check_noise(observations, noise)?;
        let trunk = &self.architecture.trunk;
        let (rows, embeddings) = (noise.dim(1)?, self.embeddings()?);
        #[cfg(feature = "cuda")]
        if let Some(dense) = crate::gpu::dense::dense(&trunk.layers, &self.weights) {
            let (parts, steps) = ([observations, &embeddings], self.reverse_steps()?);
            return crate::gpu::dense::sample(dense, &self.weights, parts, noise, &steps);
        }
        let observations = plain::repeat_rows(observations, rows / observations.dim(0)?)?;
        self.reverse_process(noise, |t, actions| {
            let embedding = embeddings.get(t - 1)?.broadcast_left(rows)?.contiguous()?;
            let inputs = [&observations, actions, &embedding];
            trunk.forward(&self.weights, &inputs)?.squeeze(0)
        })
    }

    /// a^0 from the `noise` of [`Self::sample`] and the noise that `predict` finds in a^t.
    pub(super) fn reverse_process(
        &self,
        noise: &Tensor,
        predict: impl Fn(usize, &Tensor) -> Result<Tensor>,
    ) -> Result<Tensor> {
        let (steps, mut actions) = (noise.dim(0)?, noise.get(0)?);
        for t in (1..=steps).rev() {
            let epsilon = predict(t, &actions)?;
            let z = (t > 1).then(|| noise.get(steps - t + 1)).transpose()?;
            actions = self.schedule().reverse(t, &actions, &epsilon, z.as_ref())?;
        }
        Ok(actions)
    }

    /// [`Self::sample`], differentiable in the weights through every reverse step; slower.
    pub fn sample_with_gradient(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        self.check_noise(observations, noise)?;
        let rows = noise.dim(1)?;
        let observations = plain::repeat_rows(observations, rows / observations.dim(0)?)?;
        self.reverse_process(noise, |t, actions| {
            let times = Tensor::full(t as u32, rows, noise.device())?;
            self.predict(&observations, actions, &times)
        })
    }

    pub(super) fn check_noise(&self, observations: &Tensor, noise: &Tensor) -> Result<()> {
        let shape = &self.architecture.shape;
        let ((states, o), (steps, rows, a)) = (observations.dims2()?, noise.dims3()?);
        let is_whole = states > 0 && rows > 0 && rows.is_multiple_of(states);
        let fits = (o, a) == (shape.observation_dim, shape.action_dim);
        if !is_whole || !fits || steps != shape.diffusion_steps {
            let noise = noise.shape();
            bail!("a noise predictor of {shape:?} got {states} × {o} and noise {noise:?}");
        }
        Ok(())
    }
}
