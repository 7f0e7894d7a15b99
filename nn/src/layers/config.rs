//! Hidden layers as a line of configuration.

use crate::error::MAX_DIM;
use crate::weights::Init;
use quad_kernels::activation::Activation;
use serde::de::{Deserializer, Error};
use serde::{Deserialize, Serialize};

/// Most hidden layers that are believed.
const MOST_LAYERS: usize = 64;

/// A network's hidden layers, as a configuration or a policy's file has them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MlpConfig {
    /// Their widths: from 1 to 64 of them, each from 1 to 65535.
    #[serde(deserialize_with = "widths")]
    pub hidden: Vec<usize>,
    /// What follows each of them.
    pub activation: Activation,
    /// Whether a layer norm (Ba et al. 2016) stands before each activation.
    #[serde(default)]
    pub norm: bool,
    /// Whether it stands after each activation instead.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub norm_after: bool,
    /// What the norm adds to the variance.
    #[serde(default, skip_serializing_if = "Epsilon::is_default")]
    pub norm_epsilon: Epsilon,
    /// What the weights begin with.
    #[serde(default)]
    pub initial: Initial,
}

/// What a layer norm adds to the variance, ε.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Epsilon {
    /// 1e-6, as in Flax.
    #[default]
    Flax,
    /// 1e-5, as in PyTorch.
    Torch,
}

impl Epsilon {
    /// The number.
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

/// What a network's weights begin with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Initial {
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
    /// ReBRAC's critics, whose last layer is U(±0.003).
    #[serde(rename = "rebrac-critic")]
    RebracCritic,
}

impl Initial {
    /// Initial values of the kernel and bias of a linear layer, the last or another.
    pub(crate) fn of_layer(self, inputs: usize, outputs: usize, last: bool) -> (Init, Init) {
        match self {
            Self::RebracActor if last => (Init::Uniform(1e-3), Init::Uniform(1e-3)),
            Self::RebracCritic if last => (Init::Uniform(3e-3), Init::Uniform(3e-3)),
            Self::RebracActor | Self::RebracCritic => {
                (Init::Uniform(1.0 / (inputs as f32).sqrt()), Init::Constant(0.1))
            }
            Self::Xavier => {
                (Init::Uniform((6.0 / (inputs + outputs) as f32).sqrt()), Init::Constant(0.0))
            }
            Self::Orthogonal => (Init::Orthogonal(std::f32::consts::SQRT_2), Init::Constant(0.0)),
            Self::Orthonormal => (Init::Orthogonal(1.0), Init::Constant(0.0)),
            Self::Torch => {
                let bound = 1.0 / (inputs as f32).sqrt();
                (Init::Uniform(bound), Init::Uniform(bound))
            }
        }
    }
}

impl MlpConfig {
    /// Hidden layers of these widths, with Mish and nothing else.
    pub fn mish(hidden: &[usize]) -> Self {
        Self { hidden: hidden.to_vec(), ..Self::default() }
    }

    /// Numbers of the widest hidden layer.
    pub(crate) fn widest(&self) -> usize {
        self.hidden.iter().copied().max().unwrap_or(1)
    }
}

fn widths<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<usize>, D::Error> {
    let widths = Vec::<usize>::deserialize(deserializer)?;
    if (1..=MOST_LAYERS).contains(&widths.len())
        && widths.iter().all(|width| (1..=MAX_DIM).contains(width))
    {
        return Ok(widths);
    }
    Err(D::Error::custom(format_args!(
        "hidden layers are 1 to {MOST_LAYERS} widths from 1 to {MAX_DIM}, not {widths:?}"
    )))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn a_configuration_names_what_a_norm_adds_only_where_it_is_not_the_usual() {
        let config =
            MlpConfig { norm: true, norm_epsilon: Epsilon::Torch, ..MlpConfig::mish(&[4]) };
        let json = serde_json::to_string(&config).unwrap();
        assert!(json.contains(r#""norm_epsilon":"torch""#), "{json}");
        assert_eq!(serde_json::from_str::<MlpConfig>(&json).unwrap(), config);
        assert!(!serde_json::to_string(&MlpConfig::mish(&[4])).unwrap().contains("norm_"));
    }

    #[test]
    fn rebrac_s_last_layer_begins_smaller_than_the_others() {
        let shape = |initial| {
            let layers = MlpConfig { initial, ..MlpConfig::mish(&[4]) };
            crate::shape::EnsembleShape {
                members: 1,
                observation_dim: 16,
                action_dim: 0,
                layers,
                outputs: 2,
            }
        };
        for (initial, last) in [(Initial::RebracActor, 1e-3), (Initial::RebracCritic, 3e-3)] {
            let starts: Vec<Init> =
                shape(initial).layout().parts().iter().map(|part| part.start).collect();
            let (first, last) =
                ([Init::Uniform(0.25), Init::Constant(0.1)], [Init::Uniform(last); 2]);
            assert_eq!(starts, [first, last].concat());
        }
    }

    #[test]
    fn orthogonal_weights_have_the_gain_that_their_name_says() {
        let gains = [Initial::Orthogonal, Initial::Orthonormal]
            .map(|initial| initial.of_layer(3, 5, false).0);
        assert_eq!(gains, [Init::Orthogonal(std::f32::consts::SQRT_2), Init::Orthogonal(1.0)]);
    }
}
