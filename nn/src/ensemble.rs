//! K networks of one shape side by side: critics Q_1..Q_K over [s, a], a value function or a
//! policy's mean over s.

use crate::error::NetworkError;
use crate::layers::action_gradients::ActionGradients;
use crate::layers::composed::Pass;
use crate::layers::mlp::Mlp;
use crate::layers::operation::OnCpu;
use crate::layers::packed::Packing;
use crate::layers::plain;
use crate::precision::Precision;
use crate::shape::EnsembleShape;
use crate::weighted::weighted;
use crate::weights::{Tensors, Weights};
use candle_core::{Result, Tensor, Var, bail};

/// An ensemble and its weights.
pub struct Ensemble {
    shape: EnsembleShape,
    networks: Mlp,
    weights: Weights,
    packing: Packing,
}

weighted!(Ensemble, networks);

impl Ensemble {
    /// `weights` are of the shape's layout; `precision` is for what no gradient is taken of.
    pub fn new(shape: EnsembleShape, weights: Weights, precision: Precision) -> Self {
        let networks = Mlp::new(shape.layers(), "");
        Self { shape, networks, weights, packing: Packing::new(precision) }
    }

    /// Takes the tensors of such networks out of `tensors`, for a policy that acts.
    pub fn take(
        shape: EnsembleShape,
        tensors: &mut Tensors,
        prefix: &str,
        precision: Precision,
    ) -> std::result::Result<Self, NetworkError> {
        let weights = Weights::take(shape.layout(), tensors, prefix)?;
        Ok(Self::new(shape, weights, precision).packed()?)
    }

    /// Its shape.
    pub fn shape(&self) -> &EnsembleShape {
        &self.shape
    }

    /// Copies the networks, with constant weights: a target network at its beginning.
    pub fn copy(&self) -> Result<Self> {
        Ok(Self::new(self.shape.clone(), self.weights.copy()?, self.packing.precision))
    }

    /// Makes constants of the weights; they share the memory of these networks.
    pub fn detach(&self) -> Self {
        let (shape, networks) = (self.shape.clone(), self.networks.clone());
        Self {
            shape,
            networks,
            weights: self.weights.detach(),
            packing: Packing::new(self.packing.precision),
        }
    }

    /// What comes out, `[K, rows, outputs]`, a row for each action.
    ///
    /// `observations` is `[n, o]`; `actions` `[rows, a]`, where equally many consecutive rows share
    /// an observation. Differentiable in weights, observations and actions.
    pub fn outputs(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        self.check(observations, actions)?;
        let constant =
            !(self.weights.values().track_op() || observations.track_op() || actions.track_op());
        let fast = constant && self.networks.is_fast(&self.weights);
        let packed = if fast { self.packing.kernels(&self.networks, &self.weights)? } else { None };
        let observations =
            plain::repeat_rows(observations, actions.dim(0)? / observations.dim(0)?)?;
        let inputs = [&observations, actions];
        let inputs = if self.shape.action_dim == 0 { &inputs[..1] } else { &inputs };
        self.networks.forward_by(packed, &self.weights, inputs)
    }

    /// Q_k(s, a), `[K, rows]`, of networks with one output; the arguments are those of
    /// [`Self::outputs`].
    pub fn values(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        self.outputs(observations, actions)?.squeeze(2)
    }

    /// Values of networks that see only the state, `[K, n]`.
    pub fn state_values(&self, observations: &Tensor) -> Result<Tensor> {
        self.state_outputs(observations)?.squeeze(2)
    }

    /// What comes out of networks of s alone: `[K, n, outputs]`.
    pub fn state_outputs(&self, observations: &Tensor) -> Result<Tensor> {
        let none =
            Tensor::zeros((observations.dim(0)?, 0), observations.dtype(), observations.device())?;
        self.outputs(observations, &none)
    }

    /// Mean over members and rows of (Q_k(s, a) - y)², `[]`, for `targets` y `[rows]`, which are
    /// constants.
    pub fn squared_error(
        &self,
        observations: &Tensor,
        actions: &Tensor,
        targets: &Tensor,
    ) -> Result<Tensor> {
        self.values(observations, actions)?.broadcast_sub(&targets.detach())?.sqr()?.mean_all()
    }

    /// ∇_a Q_k(s, a) of each member, `[K, rows, a]`, as constants.
    pub fn action_gradients(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        self.check(observations, actions)?;
        let weights = self.weights.values().detach();
        if !self.networks.is_fast(&self.weights) || self.shape.outputs != 1 {
            return self.plain_action_gradients(observations, actions);
        }
        let operation = OnCpu(ActionGradients { networks: self.networks.clone() });
        weights.apply_op3_no_bwd(&observations.contiguous()?, &actions.contiguous()?, &operation)
    }

    fn check(&self, observations: &Tensor, actions: &Tensor) -> Result<()> {
        let EnsembleShape { observation_dim, action_dim, .. } = self.shape;
        let ((n, o), (rows, a)) = (observations.dims2()?, actions.dims2()?);
        if n == 0 || rows == 0 || rows % n != 0 || (o, a) != (observation_dim, action_dim) {
            bail!(
                "networks of {observation_dim} and {action_dim} numbers got {n} × {o} and {rows} × {a}"
            );
        }
        Ok(())
    }

    /// [`Self::action_gradients`] in plain candle operations. One backward pass gives the gradients
    /// of all members at actions of their own: none has a part in another's.
    fn plain_action_gradients(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        let repeat = actions.dim(0)? / observations.dim(0)?;
        let (action_dim, layers) = (self.shape.action_dim, &self.networks.layers);
        if !layers.norm {
            let x = Tensor::cat(&[&plain::repeat_rows(observations, repeat)?, actions], 1)?;
            let pass = Pass::forward(layers, &self.weights, &x, true)?;
            let (_, gradients) = pass.backward(&pass.out.ones_like()?, false, true)?;
            let gradients = gradients
                .ok_or_else(|| candle_core::Error::Msg("no gradient was asked for".into()))?;
            return gradients.narrow(2, self.shape.observation_dim, action_dim)?.contiguous();
        }
        let observations =
            plain::repeat_rows(observations, repeat)?.broadcast_left(self.shape.members)?;
        let actions = Var::from_tensor(&actions.broadcast_left(self.shape.members)?)?;
        let inputs = Tensor::cat(&[&observations, actions.as_tensor()], 2)?;
        let values = self.networks.plain_forward(&self.weights.detach(), &inputs)?;
        let gradients = values.sum_all()?.backward()?.remove(&actions);
        gradients.ok_or_else(|| candle_core::Error::Msg("no gradient reaches the actions".into()))
    }
}
