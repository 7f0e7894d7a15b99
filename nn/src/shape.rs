//! The shapes of networks: hidden layers, and what goes in and comes out.

use crate::diffusion::schedule::Reverse;
use crate::layers::config::MlpConfig;
use crate::layers::flat::{Layers, TILE};
use crate::weights::Layout;

/// Size of the sinusoidal features of a denoising step.
pub(crate) const TIME_FEATURES: usize = 16;
/// Width of the network that embeds them, and of its output.
pub(crate) const TIME_EMBEDDING: usize = 32;

/// The shape of an ensemble.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EnsembleShape {
    /// Networks, K.
    pub members: usize,
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a; 0 for networks of s alone.
    pub action_dim: usize,
    /// The hidden layers of each.
    pub layers: MlpConfig,
    /// Numbers that come out.
    pub outputs: usize,
}

impl EnsembleShape {
    pub(crate) fn layers(&self) -> Layers {
        Layers::new(
            self.members,
            self.observation_dim + self.action_dim,
            &self.layers,
            self.outputs,
            0,
        )
    }

    /// Numbers that it takes to run all networks forward on so many states, `repeat` rows for each.
    pub fn memory(&self, states: u128, repeat: u128) -> u128 {
        let rows = states * repeat * self.members as u128;
        let inside = match self.layers.norm {
            false => tile_numbers(repeat, &self.layers),
            // The plain implementation keeps whole layers: input and output of an operation.
            true => rows * 4 * self.layers.widest() as u128,
        };
        // An observation for each action, and both side by side.
        let fed = states * repeat * (2 * self.observation_dim + self.action_dim) as u128;
        rows * self.outputs as u128 + fed + inside
    }

    /// Tensors `{0..}.kernel` `[K, in, out]` and `{0..}.bias` `[K, out]`, and with a norm `.scale`
    /// and `.shift` `[K, out]`.
    pub fn layout(&self) -> Layout {
        Layout::new(self.layers().named("", true))
    }
}

/// Numbers that the threads keep of the tiles of rows that they are at: rows of one state are not
/// parted, and of each row there are some hidden layers.
pub fn tile_numbers(repeat: u128, layers: &MlpConfig) -> u128 {
    let each = (2 * layers.hidden.len()).max(4) * layers.widest();
    (rayon::current_num_threads() * each) as u128 * repeat.max(TILE as u128)
}

/// Bytes of so many numbers, or as many as can be said.
pub fn bytes(numbers: u128) -> u64 {
    u64::try_from(4 * numbers).unwrap_or(u64::MAX)
}

/// The shape of a noise predictor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NoiseShape {
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a.
    pub action_dim: usize,
    /// Its hidden layers.
    pub layers: MlpConfig,
    /// Denoising steps T.
    pub diffusion_steps: usize,
    /// How each of them is made when sampling.
    pub reverse: Reverse,
}

impl NoiseShape {
    /// The network that embeds a denoising step; always the same.
    pub(crate) fn time_layers(&self) -> Layers {
        let config =
            MlpConfig { initial: self.layers.initial, ..MlpConfig::mish(&[TIME_EMBEDDING]) };
        Layers::new(1, TIME_FEATURES, &config, TIME_EMBEDDING, 0)
    }

    pub(crate) fn trunk_layers(&self) -> Layers {
        let input = self.observation_dim + self.action_dim + TIME_EMBEDDING;
        Layers::new(1, input, &self.layers, self.action_dim, self.time_layers().range().end)
    }

    /// Tensors `time.{0,1}` and `trunk.{0..}`, each with `.kernel` `[in, out]` and `.bias` `[out]`.
    pub fn layout(&self) -> Layout {
        let mut parts = self.time_layers().named("time.", false);
        parts.extend(self.trunk_layers().named("trunk.", false));
        Layout::new(parts)
    }
}
