//! Networks over windows of consecutive steps: their configuration, and the named tensors of their
//! layers.

use crate::error::MAX_DIM;
use crate::weights::{Init, Layout, TensorSpec};
use serde::{Deserialize, Serialize};

/// Taps of a block's convolutions.
const TAPS: usize = 5;
/// Most levels that are believed.
const MOST_LEVELS: usize = 8;
/// Longest window that is believed.
const MOST_STEPS: usize = 1000;

/// The networks over windows of a planner (Janner et al. 2022), as a configuration or a policy's
/// file has them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrajectoryConfig {
    /// Steps in a window, H.
    pub horizon: usize,
    /// Numbers of the embedding of a denoising step, and what `multipliers` multiply.
    pub channels: usize,
    /// Channels of each level, in multiples of `channels`. A level has half as many steps as the
    /// one before.
    pub multipliers: Vec<usize>,
    /// Groups of channels whose numbers are normed together.
    pub groups: usize,
    /// The attention behind each level of the model, if there is one; the value network has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attention: Option<Attention>,
}

/// Linear attention between the steps of a window.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Attention {
    /// Heads.
    pub heads: usize,
    /// Numbers in a query of a head.
    pub width: usize,
}

/// A number of a window's networks that is out of range.
#[derive(Debug, PartialEq, Eq)]
pub struct TrajectoryError {
    /// Its name.
    pub field: &'static str,
    /// The number.
    pub value: usize,
    /// What it must be.
    pub range: &'static str,
}

impl TrajectoryConfig {
    /// Checks that there are such networks.
    ///
    /// # Errors
    /// The first number that is out of range.
    pub fn check(&self) -> Result<(), TrajectoryError> {
        let Self { horizon, channels, groups, .. } = *self;
        let levels = self.multipliers.len();
        let is = |field, value, holds: bool, range| {
            if holds { Ok(()) } else { Err(TrajectoryError { field, value, range }) }
        };
        is("multipliers", levels, (1..=MOST_LEVELS).contains(&levels), "1 to 8 numbers")?;
        is("groups", groups, (1..=MAX_DIM).contains(&groups), "from 1 to 65535")?;
        let even = (4..=MAX_DIM).contains(&channels) && channels.is_multiple_of(2);
        is("channels", channels, even, "an even number from 4 to 65535")?;
        let (halves, most) = (1 << (levels - 1), (1..=MOST_STEPS).contains(&horizon));
        is(
            "horizon",
            horizon,
            most && horizon.is_multiple_of(halves),
            "from 1 to 1000 and halved once for each further level",
        )?;
        for multiplier in &self.multipliers {
            let wide = channels.saturating_mul(*multiplier);
            let holds = (1..=MAX_DIM).contains(&wide) && wide.is_multiple_of(groups);
            is(
                "multipliers",
                *multiplier,
                holds,
                "such that channels times it is at most 65535 and divided by groups",
            )?;
        }
        let last = self.widths().last().copied().unwrap_or_default();
        is(
            "multipliers",
            last,
            last.is_multiple_of(4 * groups),
            "such that a quarter of the last level's channels is divided by groups",
        )?;
        let Attention { heads, width } = self.attention.unwrap_or(Attention { heads: 1, width: 1 });
        is("heads", heads, (1..=MAX_DIM).contains(&heads), "from 1 to 65535")?;
        is(
            "width",
            width,
            (1..=MAX_DIM / heads).contains(&width),
            "at least 1, and with the heads at most 65535",
        )
    }

    /// Channels of each level.
    pub fn widths(&self) -> Vec<usize> {
        self.multipliers.iter().map(|multiplier| self.channels * multiplier).collect()
    }

    /// Steps of each level.
    pub fn lengths(&self) -> Vec<usize> {
        (0..self.multipliers.len()).map(|level| self.horizon >> level).collect()
    }
}

/// The named tensors of a network over windows, one layer after the other. What they begin with is
/// PyTorch's.
pub(crate) struct Parts {
    parts: Vec<TensorSpec>,
    /// Numbers of the embedding of a denoising step.
    embedding: usize,
    attention: Option<Attention>,
}

impl Parts {
    /// Begins with the embedding of a denoising step: `time.{0,1}`.
    pub fn new(config: &TrajectoryConfig) -> Self {
        let embedding = config.channels;
        let mut parts = Self { parts: Vec::new(), embedding, attention: config.attention };
        parts.linear("time.0", embedding, 4 * embedding);
        parts.linear("time.1", 4 * embedding, embedding);
        parts
    }

    pub fn layout(self) -> Layout {
        Layout::new(self.parts)
    }

    fn add(&mut self, name: &str, kind: &str, shape: &[usize], start: Init) {
        self.parts.push(TensorSpec {
            name: format!("{name}.{kind}"),
            shape: shape.to_vec(),
            start,
        });
    }

    /// A kernel and a bias, of so many products in each sum.
    fn kernel(&mut self, name: &str, shape: &[usize], outputs: usize, products: usize) {
        let start = Init::Uniform(1.0 / (products as f32).sqrt());
        self.add(name, "kernel", shape, start);
        self.add(name, "bias", &[outputs], start);
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

    /// A residual block: two convolutions `.0` and `.1`, the step's part `.time`, and `.skip` where
    /// widths differ.
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

    /// Attention, if the configuration has it: a layer norm, `.queries.kernel [C, 3 · heads ·
    /// width]` without a bias for queries, keys and values, and `.out`.
    pub fn attention(&mut self, name: &str, channels: usize) {
        let Some(Attention { heads, width }) = self.attention else { return };
        self.norm(name, channels);
        let start = Init::Uniform(1.0 / (channels as f32).sqrt());
        self.add(name, "queries.kernel", &[channels, 3 * heads * width], start);
        self.linear(&format!("{name}.out"), heads * width, channels);
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn refused(change: impl Fn(&mut TrajectoryConfig)) -> &'static str {
        let mut config = TrajectoryConfig {
            horizon: 16,
            channels: 16,
            multipliers: vec![1, 2, 4],
            groups: 8,
            attention: None,
        };
        config.check().unwrap();
        change(&mut config);
        config.check().unwrap_err().field
    }

    #[test]
    fn what_cannot_be_is_refused() {
        assert_eq!(refused(|config| config.multipliers.clear()), "multipliers");
        assert_eq!(refused(|config| config.multipliers = vec![1, 1]), "multipliers");
        assert_eq!(refused(|config| config.multipliers[1] = usize::MAX), "multipliers");
        assert_eq!(refused(|config| config.multipliers[1] = 0), "multipliers");
        assert_eq!(refused(|config| config.groups = 0), "groups");
        assert_eq!(refused(|config| config.channels = 7), "channels");
        assert_eq!(refused(|config| config.horizon = 18), "horizon");
        assert_eq!(refused(|config| config.horizon = 0), "horizon");
        assert_eq!(
            refused(|config| config.attention = Some(Attention { heads: 0, width: 1 })),
            "heads"
        );
        assert_eq!(
            refused(|config| config.attention = Some(Attention { heads: 2, width: usize::MAX })),
            "width"
        );
    }
}
