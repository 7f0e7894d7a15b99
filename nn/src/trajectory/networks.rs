//! The two networks of a planner over windows of [action, state] (Janner et al. 2022): a temporal
//! U-Net, which predicts the clean window in a noisy one, and a value network, which predicts the
//! return from its first step on.

use crate::trajectory::config::{Parts, TrajectoryConfig};
use crate::trajectory::layers::Layers;
use crate::weighted::Weighted;
use crate::weights::{Layout, Weights};
use candle_core::{Result, Tensor};

/// The U-Net and its weights.
pub struct TrajectoryModel {
    config: TrajectoryConfig,
    weights: Weights,
}

/// The value network and its weights.
pub struct TrajectoryValue {
    config: TrajectoryConfig,
    weights: Weights,
}

impl TrajectoryModel {
    /// Tensors of a network over windows of `width` numbers a step: `time`, for each level from the
    /// longest windows down `down.{0..}` with two blocks, `attention` and `halve`, then two blocks
    /// `middle`, for each level up again `up.{0..}` with two blocks, `attention` and `double`,
    /// `last`, and `out`.
    pub fn layout(config: &TrajectoryConfig, width: usize) -> Layout {
        let (mut parts, widths) = (Parts::new(config), config.widths());
        let inputs = [width].into_iter().chain(widths.iter().copied());
        let last = widths.len() - 1;
        for (level, (inputs, outputs)) in inputs.zip(widths.iter().copied()).enumerate() {
            parts.block(&format!("down.{level}.0"), inputs, outputs);
            parts.block(&format!("down.{level}.1"), outputs, outputs);
            parts.attention(&format!("down.{level}.attention"), outputs);
            if level < last {
                parts.halve(&format!("down.{level}.halve"), outputs);
            }
        }
        parts.block("middle.0", widths[last], widths[last]);
        parts.attention("middle.attention", widths[last]);
        parts.block("middle.1", widths[last], widths[last]);
        for (level, pair) in widths.windows(2).rev().enumerate() {
            parts.block(&format!("up.{level}.0"), 2 * pair[1], pair[0]);
            parts.block(&format!("up.{level}.1"), pair[0], pair[0]);
            parts.attention(&format!("up.{level}.attention"), pair[0]);
            parts.double(&format!("up.{level}.double"), pair[0]);
        }
        parts.normed("last", widths[0], widths[0]);
        parts.linear("out", widths[0], width);
        parts.layout()
    }

    /// `weights` are of [`Self::layout`].
    pub fn new(config: TrajectoryConfig, weights: Weights) -> Self {
        Self { config, weights }
    }

    /// The clean windows in noisy ones, `x [B, H, width]`; `t` has the denoising step of each, in
    /// 1..=T. Differentiable in weights and windows.
    pub fn clean(&self, x: &Tensor, t: &[u32]) -> Result<Tensor> {
        let layers = Layers::new(&self.weights, &self.config)?;
        let time = layers.time(t, x.device())?;
        let last = self.config.multipliers.len() - 1;
        let (mut x, mut left) = (x.clone(), Vec::new());
        for level in 0..=last {
            x = layers.block(&format!("down.{level}.0"), &x, &time)?;
            x = layers.block(&format!("down.{level}.1"), &x, &time)?;
            x = layers.attend(&format!("down.{level}.attention"), &x)?;
            left.push(x.clone());
            if level < last {
                x = layers.halve(&format!("down.{level}.halve"), &x)?;
            }
        }
        x = layers.block("middle.0", &x, &time)?;
        x = layers.attend("middle.attention", &x)?;
        x = layers.block("middle.1", &x, &time)?;
        for (level, beside) in left[1..].iter().rev().enumerate() {
            x = layers.block(&format!("up.{level}.0"), &Tensor::cat(&[&x, beside], 2)?, &time)?;
            x = layers.block(&format!("up.{level}.1"), &x, &time)?;
            x = layers.attend(&format!("up.{level}.attention"), &x)?;
            x = layers.double(&format!("up.{level}.double"), &x)?;
        }
        layers.linear("out", &layers.normed("last", &x)?)
    }
}

impl TrajectoryValue {
    /// Tensors of a network over windows of `width` numbers a step: `time`, for each level
    /// `level.{0..}` with two blocks and `halve`, then `middle.{0,1}` with a block and `halve`
    /// each, and `head.{0,1}`.
    pub fn layout(config: &TrajectoryConfig, width: usize) -> Layout {
        let (mut parts, widths) = (Parts::new(config), config.widths());
        let inputs = [width].into_iter().chain(widths.iter().copied());
        for (level, (inputs, outputs)) in inputs.zip(widths.iter().copied()).enumerate() {
            parts.block(&format!("level.{level}.0"), inputs, outputs);
            parts.block(&format!("level.{level}.1"), outputs, outputs);
            parts.halve(&format!("level.{level}.halve"), outputs);
        }
        let last = widths[widths.len() - 1];
        for (level, (inputs, outputs)) in
            [(last, last / 2), (last / 2, last / 4)].into_iter().enumerate()
        {
            parts.block(&format!("middle.{level}.0"), inputs, outputs);
            parts.halve(&format!("middle.{level}.halve"), outputs);
        }
        let steps = (0..widths.len() + 2).fold(config.horizon, |steps, _| steps.div_ceil(2));
        let flat = steps * last / 4;
        parts.linear("head.0", flat + config.channels, (flat / 2).max(1));
        parts.linear("head.1", (flat / 2).max(1), 1);
        parts.layout()
    }

    /// `weights` are of [`Self::layout`].
    pub fn new(config: TrajectoryConfig, weights: Weights) -> Self {
        Self { config, weights }
    }

    /// The returns of noisy windows, `x [B, H, width]` → `[B]`; `t` has the denoising step of each,
    /// in 1..=T. Differentiable in weights and windows.
    pub fn values(&self, x: &Tensor, t: &[u32]) -> Result<Tensor> {
        let layers = Layers::new(&self.weights, &self.config)?;
        let time = layers.time(t, x.device())?;
        let mut x = x.clone();
        for level in 0..self.config.multipliers.len() {
            x = layers.block(&format!("level.{level}.0"), &x, &time)?;
            x = layers.block(&format!("level.{level}.1"), &x, &time)?;
            x = layers.halve(&format!("level.{level}.halve"), &x)?;
        }
        for level in 0..2 {
            x = layers.block(&format!("middle.{level}.0"), &x, &time)?;
            x = layers.halve(&format!("middle.{level}.halve"), &x)?;
        }
        let flat = Tensor::cat(&[&x.flatten_from(1)?.unsqueeze(1)?, &time.embedding], 2)?;
        layers
            .linear("head.1", &crate::layers::plain::mish(&layers.linear("head.0", &flat)?)?)?
            .flatten_all()
    }
}

impl Weighted for TrajectoryModel {
    fn weights(&self) -> &Weights {
        &self.weights
    }

    fn weights_mut(&mut self) -> &mut Weights {
        &mut self.weights
    }
}

impl Weighted for TrajectoryValue {
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
    use crate::gradients::finite_differences::{check_gradients, random};
    use crate::gradients::gradient::Gradients;
    use crate::slices::plainly;
    use crate::trajectory::config::Attention;
    use candle_core::Device;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn config() -> TrajectoryConfig {
        let attention = Some(Attention { heads: 2, width: 2 });
        TrajectoryConfig { horizon: 4, channels: 4, multipliers: vec![1, 2], groups: 2, attention }
    }

    /// Numbers and gradients of a network: by one operation for each layer, by plain ones, and by
    /// differences.
    fn check<N: Weighted>(
        layout: &Layout,
        network: fn(Weights) -> N,
        of: fn(&N, &Tensor) -> Result<Tensor>,
    ) {
        let values =
            Weights::initial(layout, &mut ChaCha8Rng::seed_from_u64(1), &Device::Cpu).unwrap();
        let x = random((2, 4, 3), 2);
        let run = || {
            let network = network(Weights::trainable(layout.clone(), &values).unwrap());
            let out = of(&network, &x).unwrap();
            let loss = (random(out.shape(), 3) * &out).unwrap().sum_all().unwrap();
            (
                out.detach(),
                Gradients::of(&loss).unwrap().with_respect_to(network.weights()).unwrap(),
            )
        };
        let ((fast, of_fast), (plain, of_plain)) = (run(), plainly(run));
        let largest = |x: &Tensor| x.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        for (fast, plain) in [(fast, plain), (of_fast, of_plain)] {
            let difference = largest(&(&fast - &plain).unwrap()) / largest(&plain);
            assert!(difference < 1e-4, "{difference}");
        }
        let constant = network(Weights::constant(layout.clone(), values.clone()));
        check_gradients(std::slice::from_ref(&x), |x| of(&constant, &x[0]));
    }

    #[test]
    fn the_model_has_the_gradients_of_finite_differences() {
        let layout = TrajectoryModel::layout(&config(), 3);
        check(
            &layout,
            |weights| TrajectoryModel::new(config(), weights),
            |model, x| model.clean(x, &[1, 5]),
        );
    }

    #[test]
    fn the_value_network_has_the_gradients_of_finite_differences() {
        let layout = TrajectoryValue::layout(&config(), 3);
        check(
            &layout,
            |weights| TrajectoryValue::new(config(), weights),
            |value, x| value.values(x, &[1, 5]),
        );
    }
}
