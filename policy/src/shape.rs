//! The shapes of networks: where the layers of each lie in its vector of weights, and what it takes to run one.

use crate::layers::Layers;
use crate::network::TILE;
use crate::weights::Layout;

/// Size of the sinusoidal features of a denoising step.
pub(crate) const TIME_FEATURES: usize = 16;
/// Width of the network that embeds them, and of its output.
pub(crate) const TIME_EMBEDDING: usize = 32;

/// The shape of an ensemble.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EnsembleShape {
    /// Networks, K.
    pub members: usize,
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a; 0 for networks of s alone.
    pub action_dim: usize,
    /// Width of the three hidden layers.
    pub hidden: usize,
    /// Numbers that come out.
    pub outputs: usize,
}

impl EnsembleShape {
    pub(crate) fn layers(&self) -> Layers {
        let Self { observation_dim, action_dim, hidden, .. } = *self;
        Layers::new(self.members, &[observation_dim + action_dim, hidden, hidden, hidden, self.outputs], 0)
    }

    /// Memory that running all networks forward on so many states takes, `repeat` rows for each, bytes.
    pub(crate) fn memory(&self, states: u64, repeat: u64) -> u64 {
        let outputs = states.saturating_mul(repeat).saturating_mul(self.members as u64);
        let outputs = outputs.saturating_mul(self.outputs as u64);
        outputs.saturating_add(tile_numbers(repeat, self.hidden)).saturating_mul(4)
    }

    /// Tensors `{0..3}.kernel` `[K, in, out]` and `{0..3}.bias` `[K, out]`.
    pub fn layout(&self) -> Layout {
        Layout::new(self.layers().named("", true))
    }
}

/// Numbers that the threads keep of the tiles of rows that they are at: rows of one state are not parted, and of each row
/// there are some hidden layers.
pub(crate) fn tile_numbers(repeat: u64, hidden: usize) -> u64 {
    const LAYERS: u64 = 6;
    (rayon::current_num_threads() as u64 * LAYERS).saturating_mul(repeat.max(TILE as u64)).saturating_mul(hidden as u64)
}

/// The shape of a noise predictor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NoiseShape {
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a.
    pub action_dim: usize,
    /// Width of the three hidden layers.
    pub hidden: usize,
    /// Denoising steps T.
    pub diffusion_steps: usize,
}

impl NoiseShape {
    pub(crate) fn time_layers(&self) -> Layers {
        Layers::new(1, &[TIME_FEATURES, TIME_EMBEDDING, TIME_EMBEDDING], 0)
    }

    pub(crate) fn trunk_layers(&self) -> Layers {
        let Self { observation_dim, action_dim, hidden, .. } = *self;
        let input = observation_dim + action_dim + TIME_EMBEDDING;
        Layers::new(1, &[input, hidden, hidden, hidden, action_dim], self.time_layers().end())
    }

    /// Tensors `time.{0,1}` and `trunk.{0..3}`, each with `.kernel` `[in, out]` and `.bias` `[out]`.
    pub fn layout(&self) -> Layout {
        let mut parts = self.time_layers().named("time.", false);
        parts.extend(self.trunk_layers().named("trunk.", false));
        Layout::new(parts)
    }
}
