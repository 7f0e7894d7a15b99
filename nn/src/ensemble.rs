//! K networks of one shape side by side: critics Q_1..Q_K over [s, a], a value function or a
//! policy's mean over s.

use crate::error::NetworkError;
use crate::layers::mlp::Mlp;
use crate::layers::packed::Packing;
use crate::layers::plain;
use crate::shape::EnsembleShape;
use crate::slices::read_all;
use crate::weighted::weighted;
use crate::weights::{Tensors, Weights};
use candle_core::{Error, Result, Tensor, Var, bail};
use quad_kernels::Precision;

/// An ensemble and its weights.
pub struct Ensemble {
    shape: EnsembleShape,
    networks: Mlp,
    weights: Weights,
    packing: Packing,
}

weighted!(Ensemble, networks);

impl Ensemble {
    /// An ensemble with weights of the shape's layout, whose products are in this precision.
    pub fn new(shape: EnsembleShape, weights: Weights, precision: Precision) -> Self {
        let networks = Mlp::new(shape.layers().with_precision(precision), "");
        Self { shape, networks, weights, packing: Packing::default() }
    }

    /// Loads an ensemble that acts, removing its tensors from `tensors`.
    pub fn take(
        shape: EnsembleShape,
        tensors: &mut Tensors,
        prefix: &str,
        precision: Precision,
    ) -> std::result::Result<Self, NetworkError> {
        let weights = Weights::take(shape.layout(), tensors, prefix)?;
        Ok(Self::new(shape, weights, precision).packed()?)
    }

    /// Sizes and hidden layers.
    pub fn shape(&self) -> &EnsembleShape {
        &self.shape
    }

    /// Copies the networks with constant weights, as target networks.
    pub fn copy(&self) -> Result<Self> {
        Ok(self.with_weights(self.weights.copy()?))
    }

    /// The same networks with constant weights, in the same memory.
    pub fn detach(&self) -> Self {
        self.with_weights(self.weights.detach())
    }

    fn with_weights(&self, weights: Weights) -> Self {
        let (shape, networks) = (self.shape.clone(), self.networks.clone());
        Self { shape, networks, weights, packing: Packing::default() }
    }

    /// The outputs, `[K, rows, outputs]`, for `observations` `[n, o]` and `actions` `[rows, a]`,
    /// of which the first rows/n belong to the first observation, and so on. Differentiable in
    /// weights, observations and actions.
    pub fn outputs(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        self.check(observations, actions)?;
        let (networks, weights) = (&self.networks, &self.weights);
        let mut packed = None;
        let differentiable = [weights.values(), observations, actions].map(Tensor::track_op);
        if differentiable == [false; 3] && networks.is_fast(weights) {
            packed = self.packing.kernels(networks, weights)?;
        }
        let inputs = [observations, actions];
        let count = if self.shape.action_dim == 0 { 1 } else { 2 };
        networks.forward_by(packed, weights, &inputs[..count])
    }

    /// Q_k(s, a), `[K, rows]`, of networks with one output, for the arguments of
    /// [`Self::outputs`].
    pub fn values(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        self.outputs(observations, actions)?.squeeze(2)
    }

    /// V_k(s), `[K, n]`, of networks of s alone with one output.
    pub fn state_values(&self, observations: &Tensor) -> Result<Tensor> {
        self.state_outputs(observations)?.squeeze(2)
    }

    /// The outputs of networks of s alone, `[K, n, outputs]`.
    pub fn state_outputs(&self, observations: &Tensor) -> Result<Tensor> {
        let shape = (observations.dim(0)?, 0);
        let none = Tensor::zeros(shape, observations.dtype(), observations.device())?;
        self.outputs(observations, &none)
    }

    /// ∇_a Q_k(s, a) of each member, `[K, rows, a]`, as constants.
    pub fn action_gradients(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        self.check(observations, actions)?;
        if !self.networks.is_fast(&self.weights) || self.shape.outputs != 1 {
            return self.plain_action_gradients(observations, actions);
        }
        let (observations, actions) = (observations.contiguous()?, actions.contiguous()?);
        let (states, (rows, a)) = (observations.dim(0)?, actions.dims2()?);
        let gradients = read_all(
            [self.weights.values(), &observations, &actions],
            |[weights, observations, actions]| {
                self.networks.action_gradients(weights, (observations, states), (actions, rows))
            },
        )?;
        Tensor::from_vec(gradients, (self.shape.members, rows, a), actions.device())
    }

    fn check(&self, observations: &Tensor, actions: &Tensor) -> Result<()> {
        let sizes = (self.shape.observation_dim, self.shape.action_dim);
        let ((n, o), (rows, a)) = (observations.dims2()?, actions.dims2()?);
        if n == 0 || rows == 0 || rows % n != 0 || (o, a) != sizes {
            bail!("networks of {sizes:?} numbers got {n} × {o} and {rows} × {a}");
        }
        Ok(())
    }

    /// [`Self::action_gradients`] in candle's operations. One backward pass serves all members:
    /// each has its own copy of the actions.
    fn plain_action_gradients(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        #[cfg(feature = "cuda")]
        if let Some(dense) = crate::gpu::dense::dense(&self.networks.layers, &self.weights) {
            let inputs = [observations, actions];
            return crate::gpu::dense::input_gradients(dense, &self.weights, &inputs);
        }
        let repeat = actions.dim(0)? / observations.dim(0)?;
        let observations = plain::repeat_rows(observations, repeat)?;
        let observations = observations.broadcast_left(self.shape.members)?;
        let actions = Var::from_tensor(&actions.broadcast_left(self.shape.members)?)?;
        let inputs = Tensor::cat(&[&observations, actions.as_tensor()], 2)?;
        let values = self.networks.plain_forward(&self.weights.detach(), &inputs)?;
        let gradients = values.sum_all()?.backward()?.remove(&actions);
        gradients.ok_or_else(|| Error::Msg("no gradient reaches the actions".into()))
    }
}
