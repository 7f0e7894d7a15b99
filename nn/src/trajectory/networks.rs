//! Diffuser's two networks over trajectories of [action, state] (Janner et al. 2022): a temporal
//! U-Net, which predicts the clean trajectory, and a value network, which predicts its return.

use crate::layers::plain::mish;
use crate::trajectory::config::{LayoutBuilder, TrajectoryConfig};
use crate::trajectory::layers::Layers;
use crate::weighted::weighted;
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

weighted!(TrajectoryModel);
weighted!(TrajectoryValue);

impl TrajectoryModel {
    /// Tensors of a network for `width` numbers a step: `time`; for each level `down.{0..}` with two
    /// blocks, `attention` and `halve`; two blocks `middle`; for each level up again `up.{0..}` with
    /// two blocks, `attention` and `double`; `last` and `out`.
    pub fn layout(config: &TrajectoryConfig, width: usize) -> Layout {
        let (mut layout, widths) = (LayoutBuilder::new(config), config.widths());
        let inputs = [width].into_iter().chain(widths.iter().copied());
        let last = widths.len() - 1;
        for (level, (inputs, outputs)) in inputs.zip(widths.iter().copied()).enumerate() {
            layout.block(&format!("down.{level}.0"), inputs, outputs);
            layout.block(&format!("down.{level}.1"), outputs, outputs);
            layout.attention(&format!("down.{level}.attention"), outputs);
            if level < last {
                layout.halve(&format!("down.{level}.halve"), outputs);
            }
        }
        layout.block("middle.0", widths[last], widths[last]);
        layout.attention("middle.attention", widths[last]);
        layout.block("middle.1", widths[last], widths[last]);
        for (level, pair) in widths.windows(2).rev().enumerate() {
            layout.block(&format!("up.{level}.0"), 2 * pair[1], pair[0]);
            layout.block(&format!("up.{level}.1"), pair[0], pair[0]);
            layout.attention(&format!("up.{level}.attention"), pair[0]);
            layout.double(&format!("up.{level}.double"), pair[0]);
        }
        layout.normed("last", widths[0], widths[0]);
        layout.linear("out", widths[0], width);
        layout.build()
    }

    /// A network with weights of [`Self::layout`].
    pub fn new(config: TrajectoryConfig, weights: Weights) -> Self {
        Self { config, weights }
    }

    /// The predicted clean trajectories, `[B, H, width]`, for noisy `x` and their denoising steps `t`
    /// in 1..=T. Differentiable in weights and trajectories.
    pub fn clean(&self, x: &Tensor, t: &[u32]) -> Result<Tensor> {
        let layers = Layers::new(&self.weights, &self.config)?;
        let time = layers.time(t, x.device())?;
        let last = self.config.multipliers.len() - 1;
        let (mut x, mut skips) = (x.clone(), Vec::new());
        for level in 0..=last {
            x = layers.block(&format!("down.{level}.0"), &x, &time)?;
            x = layers.block(&format!("down.{level}.1"), &x, &time)?;
            x = layers.attend(&format!("down.{level}.attention"), &x)?;
            skips.push(x.clone());
            if level < last {
                x = layers.halve(&format!("down.{level}.halve"), &x)?;
            }
        }
        x = layers.block("middle.0", &x, &time)?;
        x = layers.attend("middle.attention", &x)?;
        x = layers.block("middle.1", &x, &time)?;
        for (level, skip) in skips[1..].iter().rev().enumerate() {
            x = layers.block(&format!("up.{level}.0"), &Tensor::cat(&[&x, skip], 2)?, &time)?;
            x = layers.block(&format!("up.{level}.1"), &x, &time)?;
            x = layers.attend(&format!("up.{level}.attention"), &x)?;
            x = layers.double(&format!("up.{level}.double"), &x)?;
        }
        layers.linear("out", &layers.normed("last", &x)?)
    }
}

impl TrajectoryValue {
    /// Tensors of a network for `width` numbers a step: `time`; for each level `level.{0..}` with two
    /// blocks and `halve`; `middle.{0,1}` with a block and `halve` each; `head.{0,1}`.
    pub fn layout(config: &TrajectoryConfig, width: usize) -> Layout {
        let (mut layout, widths) = (LayoutBuilder::new(config), config.widths());
        let inputs = [width].into_iter().chain(widths.iter().copied());
        for (level, (inputs, outputs)) in inputs.zip(widths.iter().copied()).enumerate() {
            layout.block(&format!("level.{level}.0"), inputs, outputs);
            layout.block(&format!("level.{level}.1"), outputs, outputs);
            layout.halve(&format!("level.{level}.halve"), outputs);
        }
        let last = widths[widths.len() - 1];
        for (level, (inputs, outputs)) in
            [(last, last / 2), (last / 2, last / 4)].into_iter().enumerate()
        {
            layout.block(&format!("middle.{level}.0"), inputs, outputs);
            layout.halve(&format!("middle.{level}.halve"), outputs);
        }
        let steps = (0..widths.len() + 2).fold(config.horizon, |steps, _| steps.div_ceil(2));
        let flat = steps * last / 4;
        layout.linear("head.0", flat + config.channels, (flat / 2).max(1));
        layout.linear("head.1", (flat / 2).max(1), 1);
        layout.build()
    }

    /// A network with weights of [`Self::layout`].
    pub fn new(config: TrajectoryConfig, weights: Weights) -> Self {
        Self { config, weights }
    }

    /// The predicted returns, `[B]`, of noisy trajectories `x [B, H, width]` at denoising steps `t` in
    /// 1..=T. Differentiable in weights and trajectories.
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
        layers.linear("head.1", &mish(&layers.linear("head.0", &flat)?)?)?.flatten_all()
    }
}
