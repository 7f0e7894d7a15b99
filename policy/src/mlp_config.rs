//! Hidden layers as a line of configuration.

use crate::error::{PolicyError, check_range};
use crate::weights::Start;
use quad_kernels::activation::Activation;
use serde::{Deserialize, Serialize};

/// Most hidden layers that are believed.
const MOST_LAYERS: usize = 64;

/// A network's hidden layers, as a configuration or a policy's file has them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MlpConfig {
    /// Their widths.
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
    /// Of a linear layer's kernel and bias.
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

    /// That there are hidden layers, and of reasonable widths.
    ///
    /// # Errors
    /// There are none or too many, or one's width is out of range.
    pub fn check(&self, field: &'static str) -> Result<(), PolicyError> {
        if !(1..=MOST_LAYERS).contains(&self.hidden.len()) {
            return Err(PolicyError::Range { field, value: self.hidden.len() });
        }
        self.hidden.iter().try_for_each(|width| check_range(field, *width))
    }

    /// Numbers of the widest hidden layer.
    pub(crate) fn widest(&self) -> usize {
        self.hidden.iter().copied().max().unwrap_or(1)
    }
}
