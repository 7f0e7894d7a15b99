//! Hidden layers in a configuration.

use crate::error::MAX_DIM;
use crate::weights::Init;
use quad_kernels::activation::Activation;
use serde::de::{Deserializer, Error};
use serde::{Deserialize, Serialize};

const MOST_LAYERS: usize = 64;

/// A network's hidden layers, as in a configuration or a policy's file.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(
    deny_unknown_fields,
    expecting = "a network, such as {hidden=[256, 256], activation=\"relu\"}"
)]
pub struct MlpConfig {
    /// Widths: 1 to 64 of them, each from 1 to 65535.
    #[serde(deserialize_with = "widths")]
    pub hidden: Vec<usize>,
    /// Activation of each layer.
    pub activation: Activation,
    /// Layer norm (Ba et al. 2016), before each activation.
    #[serde(default)]
    pub norm: bool,
    /// Puts the norm after each activation instead.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub norm_after: bool,
    /// Number that the norm adds to the variance.
    #[serde(default, skip_serializing_if = "NormEpsilon::is_default")]
    pub norm_epsilon: NormEpsilon,
    /// Initial weights.
    #[serde(default)]
    pub initial: InitScheme,
}

/// Number ε that a layer norm adds to the variance.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NormEpsilon {
    /// 1e-6, as in Flax.
    #[default]
    Flax,
    /// 1e-5, as in PyTorch.
    Torch,
}

impl NormEpsilon {
    pub(crate) fn value(self) -> f64 {
        match self {
            Self::Flax => 1e-6,
            Self::Torch => 1e-5,
        }
    }

    fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

/// Distribution of a network's initial weights.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum InitScheme {
    /// Kernels U(±√(6/(in + out))) (Glorot and Bengio 2010), biases 0.
    #[default]
    Xavier,
    /// Kernels √2 times an orthogonal matrix (Saxe et al. 2014), biases 0.
    Orthogonal,
    /// Kernels an orthogonal matrix as it is, biases 0.
    Orthonormal,
    /// PyTorch's: kernels and biases U(±1/√in).
    Torch,
    /// ReBRAC's actor: kernels U(±1/√in), biases 0.1; the last layer's kernel and bias U(±0.001).
    #[serde(rename = "rebrac-actor")]
    RebracActor,
    /// ReBRAC's critics: as the actor, but the last layer's kernel and bias U(±0.003).
    #[serde(rename = "rebrac-critic")]
    RebracCritic,
}

impl InitScheme {
    /// Initial values of a layer's kernel and bias.
    pub(crate) fn layer(self, inputs: usize, outputs: usize, last: bool) -> (Init, Init) {
        use Init::{Constant, Orthogonal, Uniform};
        let bound = 1.0 / (inputs as f32).sqrt();
        match self {
            Self::RebracActor if last => (Uniform(1e-3), Uniform(1e-3)),
            Self::RebracCritic if last => (Uniform(3e-3), Uniform(3e-3)),
            Self::RebracActor | Self::RebracCritic => (Uniform(bound), Constant(0.1)),
            Self::Xavier => (Uniform((6.0 / (inputs + outputs) as f32).sqrt()), Constant(0.0)),
            Self::Orthogonal => (Orthogonal(std::f32::consts::SQRT_2), Constant(0.0)),
            Self::Orthonormal => (Orthogonal(1.0), Constant(0.0)),
            Self::Torch => (Uniform(bound), Uniform(bound)),
        }
    }
}

impl MlpConfig {
    /// Hidden layers of these widths with Mish.
    pub fn mish(hidden: &[usize]) -> Self {
        Self { hidden: hidden.to_vec(), ..Self::default() }
    }

    /// One hidden layer with Mish, for an embedding beside these layers.
    pub(crate) fn embedding(&self, width: usize) -> Self {
        Self { initial: self.initial, ..Self::mish(&[width]) }
    }

    pub(crate) fn widest(&self) -> usize {
        self.hidden.iter().copied().max().unwrap_or(1)
    }
}

fn widths<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<usize>, D::Error> {
    let widths = Vec::<usize>::deserialize(deserializer)?;
    let fit = widths.iter().all(|width| (1..=MAX_DIM).contains(width));
    match fit && (1..=MOST_LAYERS).contains(&widths.len()) {
        true => Ok(widths),
        false => Err(D::Error::custom(format_args!(
            "hidden layers are 1 to {MOST_LAYERS} widths from 1 to {MAX_DIM}, not {widths:?}"
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_configuration_names_epsilon_only_where_it_is_not_the_default() {
        let mut config = MlpConfig::mish(&[4]);
        let json = |config: &MlpConfig| serde_json::to_string(config).unwrap();
        assert!(!json(&config).contains("norm_"));
        config.norm_epsilon = NormEpsilon::Torch;
        let json = json(&config);
        assert!(json.contains(r#""norm_epsilon":"torch""#), "{json}");
        assert_eq!(serde_json::from_str::<MlpConfig>(&json).unwrap(), config);
    }
}
