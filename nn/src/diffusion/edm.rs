//! The denoiser of EDM (Karras et al. 2022, "Elucidating the Design Space of Diffusion-Based
//! Generative Models") over actions: a network that is told how much noise there is, by a number
//! that may be any.

use crate::diffusion::noise_predictor::sinusoids;
use crate::layers::config::MlpConfig;
use crate::layers::flat::Layers;
use crate::layers::mlp::Mlp;
use crate::shape::TIME_FEATURES;
use crate::weighted::Weighted;
use crate::weights::{Layout, Weights};
use candle_core::{Device, Result, Tensor};
use rand::Rng;

/// Deviation of clean actions that the scales below are made for, σ_data.
const SIGMA_DATA: f64 = 0.5;
/// Bounds of σ.
const SIGMA: (f64, f64) = (0.002, 80.0);
/// Scale of the logistic distribution of ln σ, whose middle is ln σ_data.
const SPREAD: f64 = 0.5;
/// Width of the network that embeds σ.
const EMBEDDING_WIDTH: usize = 32;
/// Numbers in an embedding of σ.
const EMBEDDING: usize = 16;

/// Deviations σ of the noise in some actions.
#[derive(Clone, Debug, PartialEq)]
pub struct NoiseLevels(Vec<f32>);

impl NoiseLevels {
    /// These.
    pub fn new(sigma: Vec<f32>) -> Self {
        Self(sigma)
    }

    /// Draws so many: log-logistic numbers, cut off at both ends.
    pub fn draw(count: usize, generator: &mut impl Rng) -> Self {
        let below = |sigma: f64| 1.0 / (1.0 + (-(sigma / SIGMA_DATA).ln() / SPREAD).exp());
        let (least, most) = (below(SIGMA.0), below(SIGMA.1));
        let of_share = |p: f64| SIGMA_DATA * (p / (1.0 - p)).powf(SPREAD);
        Self((0..count).map(|_| of_share(generator.random_range(least..most)) as f32).collect())
    }

    /// σ as a column, `[B, 1]`.
    pub fn sigma(&self, device: &Device) -> Result<Tensor> {
        self.column(device, |sigma| sigma)
    }

    /// c_out of Karras et al.'s Table 1, `[B, 1]`: what comes out of the network is as many times
    /// as large.
    pub fn output_scale(&self, device: &Device) -> Result<Tensor> {
        self.column(device, |sigma| sigma * SIGMA_DATA / sigma.hypot(SIGMA_DATA))
    }

    fn input_scale(&self, device: &Device) -> Result<Tensor> {
        self.column(device, |sigma| 1.0 / sigma.hypot(SIGMA_DATA))
    }

    fn skip_scale(&self, device: &Device) -> Result<Tensor> {
        self.column(device, |sigma| (SIGMA_DATA / sigma.hypot(SIGMA_DATA)).powi(2))
    }

    /// What the network is told of σ: sinusoids of ln(σ)/4, `[B, 16]`.
    fn features(&self, device: &Device) -> Result<Tensor> {
        let features: Vec<f32> =
            self.0.iter().flat_map(|sigma| sinusoids(f64::from(*sigma).ln() / 4.0)).collect();
        Tensor::from_vec(features, (self.0.len(), TIME_FEATURES), device)
    }

    fn column(&self, device: &Device, f: impl Fn(f64) -> f64) -> Result<Tensor> {
        let numbers: Vec<f32> = self.0.iter().map(|sigma| f(f64::from(*sigma)) as f32).collect();
        Tensor::from_vec(numbers, (self.0.len(), 1), device)
    }
}

/// The shape of a denoiser.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DenoiserShape {
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a.
    pub action_dim: usize,
    /// Its hidden layers. A linear map before them, as wide as the first, has no activation.
    pub layers: MlpConfig,
}

impl DenoiserShape {
    fn time_layers(&self) -> Layers {
        let config =
            MlpConfig { initial: self.layers.initial, ..MlpConfig::mish(&[EMBEDDING_WIDTH]) };
        Layers::new(1, TIME_FEATURES, &config, EMBEDDING, 0)
    }

    fn input_layers(&self) -> Layers {
        let config = MlpConfig { initial: self.layers.initial, ..MlpConfig::default() };
        let inputs = self.observation_dim + self.action_dim + EMBEDDING;
        Layers::new(1, inputs, &config, self.width(), self.time_layers().range().end)
    }

    fn trunk_layers(&self) -> Layers {
        Layers::new(1, self.width(), &self.layers, self.action_dim, self.input_layers().range().end)
    }

    fn width(&self) -> usize {
        self.layers.hidden.first().copied().unwrap_or(1)
    }

    /// Tensors `time.{0,1}`, `input.0` and `trunk.{0..}`, each with `.kernel` `[in, out]` and
    /// `.bias` `[out]`.
    pub fn layout(&self) -> Layout {
        let mut parts = self.time_layers().named("time.", false);
        parts.extend(self.input_layers().named("input.", false));
        parts.extend(self.trunk_layers().named("trunk.", false));
        Layout::new(parts)
    }
}

/// A denoiser and its weights.
pub struct Denoiser {
    /// Embeds σ.
    time: Mlp,
    /// A linear map of [s, noisy action, embedding].
    input: Mlp,
    /// Over what comes out of it.
    trunk: Mlp,
    weights: Weights,
}

impl Denoiser {
    /// `weights` are of the shape's layout.
    pub fn new(shape: &DenoiserShape, weights: Weights) -> Self {
        let time = Mlp::new(shape.time_layers(), "time.");
        let input = Mlp::new(shape.input_layers(), "input.");
        Self { time, input, trunk: Mlp::new(shape.trunk_layers(), "trunk."), weights }
    }

    /// Makes constants of the weights; they share the memory of this network.
    pub fn detach(&self) -> Self {
        let [time, input, trunk] = [&self.time, &self.input, &self.trunk].map(Clone::clone);
        Self { time, input, trunk, weights: self.weights.detach() }
    }

    /// D(a + σ·n; s, σ), the clean actions that it sees in noisy ones, within ±1 (Karras et al.'s
    /// Eq. 7): `observations [B, o]`, `noisy [B, a]` → `[B, a]`. Differentiable in weights,
    /// observations and actions.
    ///
    /// # Errors
    /// Shapes that do not fit, or candle fails.
    pub fn denoise(
        &self,
        observations: &Tensor,
        noisy: &Tensor,
        levels: &NoiseLevels,
    ) -> Result<Tensor> {
        let device = noisy.device();
        let embedding =
            self.time.forward(&self.weights, &[&levels.features(device)?])?.squeeze(0)?;
        let scaled = noisy.broadcast_mul(&levels.input_scale(device)?)?;
        // One linear map: the fast networks have hidden layers.
        let x = self
            .input
            .plain_forward(&self.weights, &Tensor::cat(&[observations, &scaled, &embedding], 1)?)?;
        let out = self.trunk.forward(&self.weights, &[&x.squeeze(0)?])?.squeeze(0)?;
        let skipped = noisy.broadcast_mul(&levels.skip_scale(device)?)?;
        (out.broadcast_mul(&levels.output_scale(device)?)? + skipped)?.clamp(-1f32, 1f32)
    }
}

impl Weighted for Denoiser {
    fn weights(&self) -> &Weights {
        &self.weights
    }

    fn weights_mut(&mut self) -> &mut Weights {
        &mut self.weights
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::gradients::gradient::Gradients;
    use crate::layers::config::Initial;
    use candle_core::Var;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn numbers(x: &Tensor) -> Vec<f32> {
        x.flatten_all().unwrap().to_vec1().unwrap()
    }

    #[test]
    fn noise_levels_are_log_logistic_and_within_their_bounds() {
        const DRAWS: usize = 40_000;
        let NoiseLevels(mut sigma) = NoiseLevels::draw(DRAWS, &mut ChaCha8Rng::seed_from_u64(1));
        assert!(sigma.iter().all(|x| (0.002..=80.0).contains(x)));
        sigma.sort_by(f32::total_cmp);
        // p/(1 − p) = (σ/0.5)²: quartiles at 0.5/√3 and 0.5·√3, and one in ten below 0.5/3.
        for (share, expected) in
            [(0.1, 0.5 / 3.0), (0.25, 0.5 / 3f32.sqrt()), (0.5, 0.5), (0.75, 0.5 * 3f32.sqrt())]
        {
            let found = sigma[(share * DRAWS as f64) as usize];
            assert!((found / expected - 1.0).abs() < 0.03, "{found} at {share}, not {expected}");
        }
    }

    /// Clean actions of deviation 0.5 with noise have deviation 1 as the network sees them, and so
    /// has what it is to predict.
    #[test]
    fn the_scales_keep_inputs_and_targets_at_variance_one() {
        for sigma in [0.002f64, 0.3, 0.5, 4.0, 80.0] {
            let levels = NoiseLevels::new(vec![sigma as f32]);
            let of = |x: Result<Tensor>| f64::from(numbers(&x.unwrap())[0]);
            let device = &Device::Cpu;
            let (skip, out) = (of(levels.skip_scale(device)), of(levels.output_scale(device)));
            let input = of(levels.input_scale(device)).powi(2) * (sigma.powi(2) + 0.25);
            let target = ((1.0 - skip).powi(2) * 0.25 + (skip * sigma).powi(2)) / out.powi(2);
            assert!(
                (input - 1.0).abs() < 1e-5 && (target - 1.0).abs() < 1e-3,
                "{sigma}: {input} {target}"
            );
        }
    }

    /// Gradients by finite differences, through a denoiser as it is and through one whose weights
    /// are constant.
    #[test]
    fn gradients_reach_weights_and_actions() {
        let generator = &mut ChaCha8Rng::seed_from_u64(2);
        let layers = MlpConfig { initial: Initial::Torch, ..MlpConfig::mish(&[12, 9]) };
        let shape = DenoiserShape { observation_dim: 3, action_dim: 2, layers };
        let start = Weights::initial(&shape.layout(), generator, &Device::Cpu).unwrap();
        let denoiser = Denoiser::new(&shape, Weights::trainable(shape.layout(), &start).unwrap());
        let tensor = |count: usize, generator: &mut ChaCha8Rng| {
            let x: Vec<f32> = (0..count).map(|_| generator.random_range(-0.5..0.5)).collect();
            Tensor::from_vec(x, (20, ()), &Device::Cpu).unwrap()
        };
        let (s, a) = (tensor(60, generator), Var::from_tensor(&tensor(40, generator)).unwrap());
        let levels = NoiseLevels::draw(20, generator);
        let loss = |denoiser: &Denoiser, a: &Tensor| {
            denoiser.denoise(&s, a, &levels).unwrap().sqr().unwrap().sum_all().unwrap()
        };
        let number = |x: Tensor| f64::from(x.to_scalar::<f32>().unwrap());
        let gradients = Gradients::of(&loss(&denoiser, &a)).unwrap();
        let (w, of_weights) = (
            denoiser.weights.values().detach(),
            gradients.with_respect_to(&denoiser.weights).unwrap(),
        );
        let of_actions = gradients.store.get(&a).unwrap().clone();
        let with = |w: Tensor| Denoiser::new(&shape, Weights::constant(shape.layout(), w));
        for (what, at, gradient) in
            [("weights", &w, &of_weights), ("actions", &a.detach(), &of_actions)]
        {
            let size = number(gradient.sqr().unwrap().sum_all().unwrap()).sqrt();
            let moved = |by: f64| (at + (gradient * (by / size)).unwrap()).unwrap();
            let value = |by: f64| match what {
                "weights" => number(loss(&with(moved(by)), &a.detach())),
                _ => number(loss(&denoiser, &moved(by))),
            };
            let found = (value(1e-2) - value(-1e-2)) / 2e-2;
            assert!((found / size - 1.0).abs() < 0.02, "{what}: {found} for {size}");
        }
        let constant = denoiser.detach();
        let gradients = Gradients::of(&loss(&constant, &a)).unwrap();
        let same = |(x, y): (&f32, &f32)| (x - y).abs() < 1e-5;
        assert!(
            numbers(gradients.store.get(&a).unwrap()).iter().zip(&numbers(&of_actions)).all(same)
        );
        assert!(
            gradients.with_respect_to(&denoiser.weights).is_err(),
            "no gradient reaches constants"
        );
    }
}
