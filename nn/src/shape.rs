//! The shapes of networks: hidden layers, inputs and outputs.

use crate::diffusion::schedule::Reverse;
use crate::layers::config::MlpConfig;
use crate::layers::flat::{Layers, TILE};
use crate::weights::Layout;

/// Sinusoidal features of a denoising step.
pub(crate) const TIME_FEATURES: usize = 16;
/// Width of the network that embeds them, and of its output.
pub(crate) const TIME_EMBEDDING: usize = 32;

/// The shape of an ensemble.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EnsembleShape {
    /// Number of networks, K.
    pub members: usize,
    /// Length of an observation s.
    pub observation_dim: usize,
    /// Length of an action a; 0 for networks of s alone.
    pub action_dim: usize,
    /// Hidden layers of each network.
    pub layers: MlpConfig,
    /// Outputs of each network.
    pub outputs: usize,
}

impl EnsembleShape {
    /// Critics Q_1..Q_K(s, a).
    pub fn critics(
        members: usize,
        (observation_dim, action_dim): (usize, usize),
        layers: &MlpConfig,
    ) -> Self {
        let (layers, outputs) = (layers.clone(), 1);
        Self { members, observation_dim, action_dim, layers, outputs }
    }

    /// One network of s.
    pub fn state_network(observation_dim: usize, layers: &MlpConfig, outputs: usize) -> Self {
        Self::critics(1, (observation_dim, 0), layers).with_outputs(outputs)
    }

    /// The networks with this number of outputs.
    pub fn with_outputs(self, outputs: usize) -> Self {
        Self { outputs, ..self }
    }

    pub(crate) fn layers(&self) -> Layers {
        let sizes = (self.observation_dim + self.action_dim, self.outputs);
        Layers::new(self.members, sizes, self.layers.clone(), 0)
    }

    /// Numbers held by a forward pass of all networks, with `repeat` rows for each state.
    pub fn floats(&self, states: u128, repeat: u128) -> u128 {
        let rows = states * repeat;
        // An observation for each action, and both side by side.
        let inputs = 2 * self.observation_dim + self.action_dim;
        let each = inputs + self.members * self.outputs;
        rows * each as u128 + tile_floats(repeat, &self.layers)
    }

    /// Tensors `{0..}.kernel` `[K, in, out]` and `{0..}.bias` `[K, out]`, and with a norm `.scale`
    /// and `.shift` `[K, out]`.
    pub fn layout(&self) -> Layout {
        Layout::new(self.layers().specs("", true))
    }
}

/// Numbers in all threads' tiles of rows. The `repeat` rows of a state share a tile, which holds
/// some hidden layers.
pub fn tile_floats(repeat: u128, layers: &MlpConfig) -> u128 {
    let each = (2 * layers.hidden.len()).max(4) * layers.widest();
    (rayon::current_num_threads() * each) as u128 * repeat.max(TILE as u128)
}

/// Bytes of this many numbers of f32, at most `u64::MAX`.
pub fn f32_bytes(floats: u128) -> u64 {
    u64::try_from(4 * floats).unwrap_or(u64::MAX)
}

/// The shape of a noise predictor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NoiseShape {
    /// Length of an observation s.
    pub observation_dim: usize,
    /// Length of an action a.
    pub action_dim: usize,
    /// Hidden layers.
    pub layers: MlpConfig,
    /// Denoising steps T.
    pub diffusion_steps: usize,
    /// Formula of a reverse step.
    pub reverse: Reverse,
}

impl NoiseShape {
    /// The network that embeds a denoising step.
    pub(crate) fn time_layers(&self) -> Layers {
        let hidden = self.layers.embedding(TIME_EMBEDDING);
        Layers::new(1, (TIME_FEATURES, TIME_EMBEDDING), hidden, 0)
    }

    /// The network of [s, a^t, embedding].
    pub(crate) fn trunk_layers(&self) -> Layers {
        let inputs = self.observation_dim + self.action_dim + TIME_EMBEDDING;
        let start = self.time_layers().range().end;
        Layers::new(1, (inputs, self.action_dim), self.layers.clone(), start)
    }

    /// Tensors `time.{0,1}` and `trunk.{0..}`, each with `.kernel` `[in, out]` and `.bias` `[out]`.
    pub fn layout(&self) -> Layout {
        let mut specs = self.time_layers().specs("time.", false);
        specs.extend(self.trunk_layers().specs("trunk.", false));
        Layout::new(specs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An evaluator refuses jobs of 256 MiB.
    #[test]
    fn forty_states_of_dtql_with_all_candidates_take_megabytes() {
        let layers = MlpConfig { norm: true, ..MlpConfig::mish(&[256; 3]) };
        let critics = EnsembleShape::critics(2, (29, 8), &layers);
        let held = f32_bytes(critics.floats(40, 1024) - tile_floats(1024, &layers));
        assert_eq!(held, 40 * 1024 * 4 * (2 * 29 + 8 + 2));
    }
}
