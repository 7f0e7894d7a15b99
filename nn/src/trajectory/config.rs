//! Configuration of Diffuser's networks, and the named tensors of their layers.

use crate::error::MAX_DIM;
use crate::weights::{Init, Layout, TensorSpec};
use serde::{Deserialize, Serialize};

/// Kernel size of a block's convolutions.
const TAPS: usize = 5;
const MOST_LEVELS: usize = 8;
/// Longest trajectory.
const MOST_STEPS: usize = 1000;

/// Diffuser's networks over trajectories (Janner et al. 2022), as in a configuration or a policy's
/// file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrajectoryConfig {
    /// Steps of a trajectory, H.
    pub horizon: usize,
    /// Channels of the first level, before its multiplier, and length of the embedding of a denoising
    /// step.
    pub channels: usize,
    /// Channels of each level, in multiples of `channels`. Each level halves the steps.
    pub multipliers: Vec<usize>,
    /// Groups of the group norms.
    pub groups: usize,
    /// Attention after each level of the model; the value network has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attention: Option<Attention>,
}

/// Linear attention between the steps of a trajectory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Attention {
    /// Number of heads.
    pub heads: usize,
    /// Length of each head's queries, keys and values.
    pub width: usize,
}

/// A number of the configuration that is out of range.
#[derive(Debug, PartialEq, Eq)]
#[allow(missing_docs)] // The names say it.
pub struct TrajectoryError {
    /// The key in `[agent]` and in a policy's file, such as `network.horizon`.
    pub field: &'static str,
    pub value: usize,
    pub range: &'static str,
}

impl TrajectoryConfig {
    /// Finds the first number that is out of range.
    pub fn check(&self) -> Result<(), TrajectoryError> {
        let (horizon, channels, groups) = (self.horizon, self.channels, self.groups);
        let levels = self.multipliers.len();
        let is = |field, value, holds: bool, range| match holds {
            true => Ok(()),
            false => Err(TrajectoryError { field, value, range }),
        };
        let up_to =
            |field, value, most, range| is(field, value, (1..=most).contains(&value), range);
        up_to("network.multipliers", levels, MOST_LEVELS, "1 to 8 numbers")?;
        up_to("network.groups", groups, MAX_DIM, "from 1 to 65535")?;
        let even = (4..=MAX_DIM).contains(&channels) && channels.is_multiple_of(2);
        let range = "an even number from 4 to 65535";
        is("network.channels", channels, even, range)?;
        let halves = horizon.is_multiple_of(1 << (levels - 1));
        let holds = (1..=MOST_STEPS).contains(&horizon) && halves;
        let range = "from 1 to 1000 and a multiple of 2^(number of multipliers − 1)";
        is("network.horizon", horizon, holds, range)?;
        for multiplier in &self.multipliers {
            let wide = channels.saturating_mul(*multiplier);
            let holds = (1..=MAX_DIM).contains(&wide) && wide.is_multiple_of(groups);
            let range = "such that channels × it is at most 65535 and a multiple of groups";
            is("network.multipliers", *multiplier, holds, range)?;
        }
        let last = self.multipliers[levels - 1];
        let range = "such that channels × the last is a multiple of 4 × groups";
        let holds = (channels * last).is_multiple_of(4 * groups);
        is("network.multipliers", last, holds, range)?;
        if let Some(Attention { heads, width }) = self.attention {
            up_to("network.attention.heads", heads, MAX_DIM, "from 1 to 65535")?;
            let range = "at least 1, and with the heads at most 65535";
            up_to("network.attention.width", width, MAX_DIM / heads, range)?;
        }
        Ok(())
    }

    /// Channels of each level.
    pub fn widths(&self) -> Vec<usize> {
        let width = |multiplier| self.channels * multiplier;
        self.multipliers.iter().map(width).collect()
    }

    /// Steps of each level.
    pub fn lengths(&self) -> Vec<usize> {
        (0..self.multipliers.len()).map(|level| self.horizon >> level).collect()
    }
}

/// The layout of a network, layer after layer, with PyTorch's initial weights.
pub(crate) struct LayoutBuilder {
    specs: Vec<TensorSpec>,
    /// Length of the embedding of a denoising step.
    embedding: usize,
    attention: Option<Attention>,
}

impl LayoutBuilder {
    /// Begins with the embedding of a denoising step: `time.{0,1}`.
    pub fn new(config: &TrajectoryConfig) -> Self {
        let embedding = config.channels;
        let mut builder = Self { specs: Vec::new(), embedding, attention: config.attention };
        builder.linear("time.0", embedding, 4 * embedding);
        builder.linear("time.1", 4 * embedding, embedding);
        builder
    }

    pub fn build(self) -> Layout {
        Layout::new(self.specs)
    }

    fn add(&mut self, name: &str, kind: &str, shape: &[usize], init: Init) {
        self.specs.push(TensorSpec::new(format!("{name}.{kind}"), shape, init));
    }

    /// A kernel and a bias; each output is a sum of `fan_in` products.
    fn kernel(&mut self, name: &str, shape: &[usize], outputs: usize, fan_in: usize) {
        let init = Init::Uniform(1.0 / (fan_in as f32).sqrt());
        self.add(name, "kernel", shape, init);
        self.add(name, "bias", &[outputs], init);
    }

    fn norm(&mut self, name: &str, channels: usize) {
        self.add(name, "scale", &[channels], Init::Constant(1.0));
        self.add(name, "shift", &[channels], Init::Constant(0.0));
    }

    /// `.kernel [in, out]` and `.bias [out]`.
    pub fn linear(&mut self, name: &str, inputs: usize, outputs: usize) {
        self.kernel(name, &[inputs, outputs], outputs, inputs);
    }

    /// A convolution with a norm: `.kernel [5, in, out]`, `.bias`, `.scale`, `.shift [out]`.
    pub fn normed(&mut self, name: &str, inputs: usize, outputs: usize) {
        self.kernel(name, &[TAPS, inputs, outputs], outputs, TAPS * inputs);
        self.norm(name, outputs);
    }

    /// A residual block: convolutions `.0` and `.1`, a linear map `.time` of the embedding, and
    /// `.skip` where widths differ.
    pub fn block(&mut self, name: &str, inputs: usize, outputs: usize) {
        self.normed(&format!("{name}.0"), inputs, outputs);
        self.linear(&format!("{name}.time"), self.embedding, outputs);
        self.normed(&format!("{name}.1"), outputs, outputs);
        if inputs != outputs {
            self.linear(&format!("{name}.skip"), inputs, outputs);
        }
    }

    /// The convolution that halves the steps: `.kernel [3, C, C]`.
    pub fn halve(&mut self, name: &str, channels: usize) {
        self.kernel(name, &[3, channels, channels], channels, 3 * channels);
    }

    /// The transposed convolution that doubles the steps: `.kernel [C, 4, C]`.
    pub fn double(&mut self, name: &str, channels: usize) {
        self.kernel(name, &[channels, 4, channels], channels, 4 * channels);
    }

    /// Attention, if configured: a layer norm, `.queries.kernel [C, 3·heads·width]` for queries, keys
    /// and values, and `.out`.
    pub fn attention(&mut self, name: &str, channels: usize) {
        let Some(Attention { heads, width }) = self.attention else { return };
        self.norm(name, channels);
        let init = Init::Uniform(1.0 / (channels as f32).sqrt());
        self.add(name, "queries.kernel", &[channels, 3 * heads * width], init);
        self.linear(&format!("{name}.out"), heads * width, channels);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_out_of_range_are_refused() {
        let config = TrajectoryConfig {
            horizon: 16,
            channels: 16,
            multipliers: vec![1, 2, 4],
            groups: 8,
            attention: None,
        };
        config.check().unwrap();
        let refused = |field: &str, change: fn(&mut TrajectoryConfig)| {
            let mut config = config.clone();
            config.attention = Some(Attention { heads: 2, width: 1 });
            change(&mut config);
            assert_eq!(config.check().unwrap_err().field, field);
        };
        refused("network.multipliers", |config| config.multipliers.clear());
        refused("network.multipliers", |config| config.multipliers = vec![1, 1]);
        refused("network.multipliers", |config| config.multipliers[1] = usize::MAX);
        refused("network.multipliers", |config| config.multipliers[1] = 0);
        refused("network.groups", |config| config.groups = 0);
        refused("network.channels", |config| config.channels = 7);
        refused("network.horizon", |config| config.horizon = 18);
        refused("network.horizon", |config| config.horizon = 0);
        refused("network.attention.heads", |config| config.attention.as_mut().unwrap().heads = 0);
        refused("network.attention.width", |config| {
            config.attention.as_mut().unwrap().width = usize::MAX
        });
    }
}
