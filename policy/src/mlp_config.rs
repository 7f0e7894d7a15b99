//! Hidden layers as a line of configuration.

use crate::error::MOST;
use crate::weights::Start;
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
    /// Whether a layer norm (Ba et al. 2016; ε = 1e-6) stands before each activation.
    #[serde(default)]
    pub norm: bool,
    /// What the weights begin with.
    #[serde(default)]
    pub initial: Initial,
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
    /// PyTorch's: kernels and biases U(±1/√in).
    Torch,
}

impl Initial {
    /// Initial values of a linear layer's kernel and bias.
    pub(crate) fn of_layer(self, inputs: usize, outputs: usize) -> (Start, Start) {
        match self {
            Self::Xavier => (Start::Uniform((6.0 / (inputs + outputs) as f32).sqrt()), Start::Constant(0.0)),
            Self::Orthogonal => (Start::Orthogonal(std::f32::consts::SQRT_2), Start::Constant(0.0)),
            Self::Torch => {
                let bound = 1.0 / (inputs as f32).sqrt();
                (Start::Uniform(bound), Start::Uniform(bound))
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
    if (1..=MOST_LAYERS).contains(&widths.len()) && widths.iter().all(|width| (1..=MOST).contains(width)) {
        return Ok(widths);
    }
    Err(D::Error::custom(format_args!("hidden layers are 1 to {MOST_LAYERS} widths from 1 to {MOST}, not {widths:?}")))
}
