//! The denoiser of EDM (Karras et al. 2022, "Elucidating the Design Space of Diffusion-Based
//! Generative Models") over actions, conditioned on the noise level σ, a real number.

use crate::diffusion::noise_predictor::sinusoids;
use crate::layers::config::MlpConfig;
use crate::layers::flat::Layers;
use crate::layers::mlp::Mlp;
use crate::shape::TIME_FEATURES;
use crate::weighted::weighted;
use crate::weights::{Layout, Weights};
use candle_core::{Device, Result, Tensor};
use quad_kernels::Precision;
use rand::Rng;

/// Standard deviation of clean actions, σ_data.
const SIGMA_DATA: f64 = 0.5;
/// Bounds of σ.
const SIGMA: (f64, f64) = (0.002, 80.0);
/// Scale of the logistic distribution of ln σ, whose mean is ln σ_data.
const SPREAD: f64 = 0.5;
/// Width of the network that embeds σ.
const EMBEDDING_WIDTH: usize = 32;
/// Length of an embedding of σ.
const EMBEDDING: usize = 16;

/// Noise levels σ of a batch of actions.
#[derive(Clone, Debug, PartialEq)]
pub struct NoiseLevels(Vec<f32>);

impl NoiseLevels {
    /// Noise levels of a batch, one for each action.
    pub fn new(sigma: Vec<f32>) -> Self {
        Self(sigma)
    }

    /// Draws `count` noise levels from a truncated log-logistic distribution.
    pub fn draw(count: usize, generator: &mut impl Rng) -> Self {
        let below = |sigma: f64| 1.0 / (1.0 + (-(sigma / SIGMA_DATA).ln() / SPREAD).exp());
        let (least, most) = (below(SIGMA.0), below(SIGMA.1));
        let quantile = |p: f64| SIGMA_DATA * (p / (1.0 - p)).powf(SPREAD);
        let mut draw = || quantile(generator.random_range(least..most)) as f32;
        Self((0..count).map(|_| draw()).collect())
    }

    /// σ as a column, `[B, 1]`.
    pub fn sigma(&self, device: &Device) -> Result<Tensor> {
        self.column(device, |sigma| sigma)
    }

    /// Scale c_out of the network's output (Karras et al., Table 1), `[B, 1]`.
    pub fn output_scale(&self, device: &Device) -> Result<Tensor> {
        self.column(device, |sigma| sigma * SIGMA_DATA / sigma.hypot(SIGMA_DATA))
    }

    /// c_in, `[B, 1]`.
    fn input_scale(&self, device: &Device) -> Result<Tensor> {
        self.column(device, |sigma| 1.0 / sigma.hypot(SIGMA_DATA))
    }

    /// c_skip, `[B, 1]`.
    fn skip_scale(&self, device: &Device) -> Result<Tensor> {
        self.column(device, |sigma| (SIGMA_DATA / sigma.hypot(SIGMA_DATA)).powi(2))
    }

    /// Sinusoids of c_noise = ln(σ)/4, `[B, 16]`.
    fn features(&self, device: &Device) -> Result<Tensor> {
        let features = |sigma: &f32| sinusoids(f64::from(*sigma).ln() / 4.0);
        let features = self.0.iter().flat_map(features).collect();
        Tensor::from_vec(features, (self.0.len(), TIME_FEATURES), device)
    }

    fn column(&self, device: &Device, f: impl Fn(f64) -> f64) -> Result<Tensor> {
        let numbers = self.0.iter().map(|sigma| f(f64::from(*sigma)) as f32);
        Tensor::from_vec(numbers.collect(), (self.0.len(), 1), device)
    }
}

/// The shape of a denoiser.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DenoiserShape {
    /// Length of an observation s.
    pub observation_dim: usize,
    /// Length of an action a.
    pub action_dim: usize,
    /// Hidden layers, after a linear map to the width of the first.
    pub layers: MlpConfig,
}

impl DenoiserShape {
    fn time_layers(&self) -> Layers {
        let hidden = self.layers.embedding(EMBEDDING_WIDTH);
        Layers::new(1, (TIME_FEATURES, EMBEDDING), hidden, 0)
    }

    fn input_layers(&self) -> Layers {
        let inputs = self.observation_dim + self.action_dim + EMBEDDING;
        let (mut config, start) = (self.layers.clone(), self.time_layers().range().end);
        config.hidden.clear();
        Layers::new(1, (inputs, self.width()), config, start)
    }

    fn trunk_layers(&self) -> Layers {
        let start = self.input_layers().range().end;
        let sizes = (self.width(), self.action_dim);
        Layers::new(1, sizes, self.layers.clone(), start)
    }

    fn width(&self) -> usize {
        self.layers.hidden.first().copied().unwrap_or(1)
    }

    /// Tensors `time.{0,1}`, `input.0` and `trunk.{0..}`, each with `.kernel` `[in, out]` and
    /// `.bias` `[out]`.
    pub fn layout(&self) -> Layout {
        let mut specs = self.time_layers().specs("time.", false);
        specs.extend(self.input_layers().specs("input.", false));
        specs.extend(self.trunk_layers().specs("trunk.", false));
        Layout::new(specs)
    }
}

/// A denoiser and its weights.
pub struct Denoiser {
    /// Embeds σ.
    time: Mlp,
    /// A linear map of [s, noisy action, embedding].
    input: Mlp,
    trunk: Mlp,
    weights: Weights,
}

weighted!(Denoiser);

impl Denoiser {
    /// A denoiser with weights of the shape's layout, whose products are in this precision.
    pub fn new(shape: &DenoiserShape, weights: Weights, precision: Precision) -> Self {
        let time = Mlp::new(shape.time_layers(), "time.");
        let input = Mlp::new(shape.input_layers(), "input.");
        let trunk = Mlp::new(shape.trunk_layers().with_precision(precision), "trunk.");
        Self { time, input, trunk, weights }
    }

    /// The same network with constant weights, in the same memory.
    pub fn detach(&self) -> Self {
        let [time, input, trunk] = [&self.time, &self.input, &self.trunk].map(Mlp::clone);
        let weights = self.weights.detach();
        Self { time, input, trunk, weights }
    }

    /// D(a + σ·n; s, σ), the predicted clean actions within ±1 (Karras et al., Eq. 7):
    /// `observations [B, o]`, `noisy [B, a]` → `[B, a]`. Differentiable in weights, observations and
    /// actions.
    pub fn denoise(
        &self,
        observations: &Tensor,
        noisy: &Tensor,
        levels: &NoiseLevels,
    ) -> Result<Tensor> {
        let device = noisy.device();
        let features = levels.features(device)?;
        let embedding = self.time.forward(&self.weights, &[&features])?.squeeze(0)?;
        let scaled = noisy.broadcast_mul(&levels.input_scale(device)?)?;
        let x = Tensor::cat(&[observations, &scaled, &embedding], 1)?;
        // The fast implementation has at least one hidden layer.
        let x = self.input.plain_forward(&self.weights, &x)?.squeeze(0)?;
        let out = self.trunk.forward(&self.weights, &[&x])?.squeeze(0)?;
        let skipped = noisy.broadcast_mul(&levels.skip_scale(device)?)?;
        (out.broadcast_mul(&levels.output_scale(device)?)? + skipped)?.clamp(-1f32, 1f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn noise_levels_are_log_logistic_within_their_bounds() {
        const DRAWS: usize = 40_000;
        let NoiseLevels(mut sigma) = NoiseLevels::draw(DRAWS, &mut ChaCha8Rng::seed_from_u64(1));
        assert!(sigma.iter().all(|x| (0.002..=80.0).contains(x)));
        sigma.sort_by(f32::total_cmp);
        for p in [0.1f32, 0.25, 0.5, 0.75] {
            let quantile = sigma[(p * DRAWS as f32) as usize];
            let expected = 0.5 * (p / (1.0 - p)).sqrt();
            assert!((quantile / expected - 1.0).abs() < 0.03, "{p}: {quantile}");
        }
    }
}
