//! K networks of one shape side by side: critics Q_1..Q_K over [s, a], a value function or a policy's mean over s.
//!
//! On the CPU custom operations of candle's do the work (`ensemble_ops`); elsewhere plain ones do.

use crate::ensemble_ops::{ActionGradients, Networks, Outputs, SquaredError};
use crate::operation::OnCpu;
use crate::plain;
use crate::precision::Precision;
use crate::rounded::RoundedOnce;
use crate::saved::{Pool, SavedActivations};
use crate::shape::EnsembleShape;
use crate::slices::{has_fast_body, read};
use crate::weights::Weights;
use candle_core::{Result, Tensor, Var, bail};
use quad_kernels::product::Rounded;
use rayon::prelude::*;
use std::sync::Arc;

/// An ensemble and its weights.
pub struct Ensemble {
    shape: EnsembleShape,
    networks: Arc<Networks>,
    weights: Weights,
    precision: Precision,
    rounded: RoundedOnce<Vec<[Rounded; 2]>>,
    saved: Pool<SavedActivations>,
    gradients: Pool<Vec<f32>>,
}

impl Ensemble {
    /// `weights` are of the shape's layout; `precision` is for what no gradient is taken of.
    pub fn new(shape: EnsembleShape, weights: Weights, precision: Precision) -> Self {
        let networks = Arc::new(Networks { shape, layers: shape.layers() });
        Self::over(networks, weights, precision)
    }

    /// Its weights.
    pub fn weights(&self) -> &Weights {
        &self.weights
    }

    /// Its weights, to be changed.
    pub fn weights_mut(&mut self) -> &mut Weights {
        &mut self.weights
    }

    /// The same networks with their weights as constants, which share their memory with these.
    pub fn frozen(&self) -> Self {
        Self::over(self.networks.clone(), self.weights.frozen(), Precision::F32)
    }

    fn over(networks: Arc<Networks>, weights: Weights, precision: Precision) -> Self {
        let (rounded, saved, gradients) = (RoundedOnce::default(), Pool::default(), Pool::default());
        Self { shape: networks.shape, networks, weights, precision, rounded, saved, gradients }
    }

    /// What comes out, `[K, rows, outputs]`, a row for each action.
    ///
    /// `observations` is `[n, o]`; `actions` `[rows, a]`, where equally many consecutive rows share an observation.
    /// Differentiable in the weights; in the actions, too, but slowly, by the plain implementation.
    pub fn outputs(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        self.check(observations, actions)?;
        let weights = self.weights.values();
        if !has_fast_body(weights.device()) || observations.track_op() || actions.track_op() {
            return self.plain_outputs(observations, actions);
        }
        let saved = match (weights.track_op(), self.weights.kept_gradient()) {
            (false, _) => None,
            (true, Some(kept)) if observations.dim(0)? == actions.dim(0)? => Some((kept, self.saved.lend())),
            _ => return self.plain_outputs(observations, actions),
        };
        let rounds = self.precision == Precision::Bf16 && saved.is_none();
        let rounded = if rounds { Some(self.rounded()?) } else { None };
        let operation = OnCpu(Outputs { networks: self.networks.clone(), rounded, saved });
        weights.apply_op3(&observations.contiguous()?, &actions.contiguous()?, operation)
    }

    /// Q_k(s, a), `[K, rows]`, of networks with one output; the arguments are those of [`Self::outputs`].
    pub fn values(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        self.outputs(observations, actions)?.squeeze(2)
    }

    /// The same of networks of s alone: `[K, n]`.
    pub fn state_values(&self, observations: &Tensor) -> Result<Tensor> {
        self.state_outputs(observations)?.squeeze(2)
    }

    /// What comes out of networks of s alone: `[K, n, outputs]`.
    pub fn state_outputs(&self, observations: &Tensor) -> Result<Tensor> {
        let none = Tensor::zeros((observations.dim(0)?, 0), observations.dtype(), observations.device())?;
        self.outputs(observations, &none)
    }

    /// Mean over members and rows of (Q_k(s, a) - y)², `[]`, for `targets` y `[rows]`, which are constants.
    ///
    /// On the CPU the backward pass begins within the forward pass: as soon as a tile's errors are known, while its
    /// activations are at hand.
    pub fn squared_error(&self, observations: &Tensor, actions: &Tensor, targets: &Tensor) -> Result<Tensor> {
        self.check(observations, actions)?;
        let weights = self.weights.values();
        let follows = observations.track_op() || actions.track_op();
        match self.weights.kept_gradient() {
            Some(kept) if has_fast_body(weights.device()) && !follows && self.shape.outputs == 1 => {
                let targets = read(targets, <[f32]>::to_vec)?;
                let of_tiles = self.gradients.lend();
                let operation = OnCpu(SquaredError { networks: self.networks.clone(), targets, kept, of_tiles });
                weights.apply_op3(&observations.contiguous()?, &actions.contiguous()?, operation)
            }
            _ => self.plain_squared_error(observations, actions, targets),
        }
    }

    /// ∇_a Q_k(s, a) of each member, `[K, rows, a]`, as constants.
    pub fn action_gradients(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        self.check(observations, actions)?;
        let weights = self.weights.values().detach();
        if !has_fast_body(weights.device()) || self.shape.outputs != 1 {
            return self.plain_action_gradients(observations, actions);
        }
        let operation = OnCpu(ActionGradients { networks: self.networks.clone() });
        weights.apply_op3_no_bwd(&observations.contiguous()?, &actions.contiguous()?, &operation)
    }

    fn check(&self, observations: &Tensor, actions: &Tensor) -> Result<()> {
        let EnsembleShape { observation_dim, action_dim, .. } = self.shape;
        let ((n, o), (rows, a)) = (observations.dims2()?, actions.dims2()?);
        if n == 0 || rows == 0 || rows % n != 0 || (o, a) != (observation_dim, action_dim) {
            bail!("networks of {observation_dim} and {action_dim} numbers got {n} × {o} and {rows} × {a}");
        }
        Ok(())
    }

    fn rounded(&self) -> Result<Arc<Vec<[Rounded; 2]>>> {
        self.rounded.get(&self.weights, |weights| {
            let round = |k| self.networks.member(weights, k).round();
            (0..self.shape.members).into_par_iter().filter_map(round).collect()
        })
    }

    /// [`Self::outputs`] in plain candle operations.
    pub(crate) fn plain_outputs(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        let weights = self.weights.layout().split(self.weights.values(), "")?;
        let repeat = actions.dim(0)? / observations.dim(0)?;
        let input = match self.shape.action_dim {
            0 => observations.clone(),
            _ => Tensor::cat(&[&plain::repeat_rows(observations, repeat)?, actions], 1)?,
        };
        plain::mlp(&weights, "", 4, &input.unsqueeze(0)?)
    }

    /// [`Self::squared_error`] in plain candle operations.
    pub(crate) fn plain_squared_error(
        &self,
        observations: &Tensor,
        actions: &Tensor,
        targets: &Tensor,
    ) -> Result<Tensor> {
        let values = self.plain_outputs(observations, actions)?.squeeze(2)?;
        values.broadcast_sub(&targets.detach())?.sqr()?.mean_all()
    }

    /// [`Self::action_gradients`] in plain candle operations. One backward pass gives the gradients of all members at actions
    /// of their own: none has a part in another's.
    pub(crate) fn plain_action_gradients(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        let weights = self.weights.layout().split(&self.weights.values().detach(), "")?;
        let repeat = actions.dim(0)? / observations.dim(0)?;
        let observations = plain::repeat_rows(observations, repeat)?.broadcast_left(self.shape.members)?;
        let actions = Var::from_tensor(&actions.broadcast_left(self.shape.members)?)?;
        let values = plain::mlp(&weights, "", 4, &Tensor::cat(&[&observations, actions.as_tensor()], 2)?)?;
        let gradients = values.sum_all()?.backward()?.remove(&actions);
        gradients.ok_or_else(|| candle_core::Error::Msg("no gradient reaches the actions".into()))
    }
}
