//! K networks of one shape side by side: critics Q_1..Q_K over [s, a], a value function or a policy's mean over s.
//!
//! On the CPU a custom operation of candle's does the work. It is cut into (member, tile of rows) and runs in parallel; the
//! cut does not depend on the number of threads, so neither do the results.

use crate::Precision;
use crate::layers::Layers;
use crate::network::{Input, Network, TILE, part, with_workspace};
use crate::plain;
use crate::record::{Lent, Records, concatenate};
use crate::rounded::RoundedOnce;
use crate::slices::{has_fast_body, read, slice};
use crate::weights::{KeptGradient, Layout, Weights};
use candle_core::{CpuStorage, CustomOp3, Result, Shape, Tensor, bail};
use quad_kernels::product::Rounded;
use rayon::prelude::*;
use std::sync::{Arc, PoisonError};

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
    fn layers(&self) -> Layers {
        let Self { observation_dim, action_dim, hidden, .. } = *self;
        Layers::new(self.members, &[observation_dim + action_dim, hidden, hidden, hidden, self.outputs], 0)
    }

    /// Tensors `{0..3}.kernel` `[K, in, out]` and `{0..3}.bias` `[K, out]`.
    pub fn layout(&self) -> Layout {
        Layout::new(self.layers().named("", true))
    }
}

/// An ensemble and its weights.
pub struct Ensemble {
    shape: EnsembleShape,
    layers: Arc<Layers>,
    weights: Weights,
    precision: Precision,
    rounded: RoundedOnce<Vec<[Rounded; 2]>>,
    records: Records,
}

impl Ensemble {
    /// `weights` are of the shape's layout; `precision` is for what no gradient is taken of.
    pub fn new(shape: EnsembleShape, weights: Weights, precision: Precision) -> Self {
        let layers = Arc::new(shape.layers());
        Self { shape, layers, weights, precision, rounded: RoundedOnce::default(), records: Records::default() }
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
        let (layers, weights) = (self.layers.clone(), self.weights.frozen());
        let (rounded, records) = (RoundedOnce::default(), Records::default());
        Self { shape: self.shape, layers, weights, precision: Precision::F32, rounded, records }
    }

    /// What comes out, `[K, rows, outputs]`, a row for each action.
    ///
    /// `observations` is `[n, o]`; `actions` `[rows, a]`, where equally many consecutive rows share an observation, or
    /// `[K, n, a]` with actions for each member. Gradients flow to the weights, or to the actions.
    pub fn outputs(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        self.check(observations.dims(), actions.dims())?;
        let weights = self.weights.values();
        let gradients = (weights.track_op(), actions.track_op());
        if !has_fast_body(weights.device()) || observations.track_op() || gradients == (true, true) {
            return self.plain_outputs(observations, actions);
        }
        let own_actions = actions.rank() == 3;
        let gradient = match gradients {
            (false, false) => Gradient::None,
            (false, true) if self.shape.outputs == 1 => Gradient::Actions(Unit::default()),
            (true, false) if !own_actions && observations.dim(0)? == actions.dim(0)? => {
                let Some(kept) = self.weights.kept_gradient() else { bail!("these weights are constants") };
                Gradient::Weights(kept, self.records.lend())
            }
            _ => return self.plain_outputs(observations, actions),
        };
        let rounds = self.precision == Precision::Bf16 && matches!(gradient, Gradient::None);
        let rounded = if rounds { Some(self.rounded()?) } else { None };
        let (shape, layers) = (self.shape, self.layers.clone());
        let operation = Outputs { shape, layers, own_actions, rounded, gradient };
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

    fn check(&self, observations: &[usize], actions: &[usize]) -> Result<()> {
        let EnsembleShape { members, observation_dim, action_dim, .. } = self.shape;
        let fits = match (observations, actions) {
            ([n, o], [rows, a]) => *n > 0 && *rows > 0 && rows % n == 0 && (*o, *a) == (observation_dim, action_dim),
            ([n, o], [k, rows, a]) => *n > 0 && n == rows && (*k, *o, *a) == (members, observation_dim, action_dim),
            _ => false,
        };
        if !fits {
            bail!("networks of {observation_dim} and {action_dim} numbers got {observations:?} and {actions:?}");
        }
        Ok(())
    }

    fn rounded(&self) -> Result<Arc<Vec<[Rounded; 2]>>> {
        self.rounded.get(&self.weights, |weights| {
            let round = |k| Network::new(weights, &self.layers, k, self.shape.dims()).round();
            (0..self.shape.members).into_par_iter().filter_map(round).collect()
        })
    }

    /// [`Self::outputs`] in plain candle operations.
    pub(crate) fn plain_outputs(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        let EnsembleShape { members, action_dim, .. } = self.shape;
        let weights = self.weights.layout().split(self.weights.values(), "")?;
        let input = match (action_dim, actions.rank()) {
            (0, _) => observations.unsqueeze(0)?,
            (_, 3) => Tensor::cat(&[&observations.broadcast_left(members)?, actions], 2)?,
            _ => {
                let repeat = actions.dim(0)? / observations.dim(0)?;
                Tensor::cat(&[&plain::repeat_rows(observations, repeat)?, actions], 1)?.unsqueeze(0)?
            }
        };
        plain::mlp(&weights, "", 4, &input)
    }
}

impl EnsembleShape {
    fn dims(&self) -> (usize, usize) {
        (self.observation_dim, self.action_dim)
    }
}

/// What a gradient will be asked for of.
enum Gradient {
    None,
    /// Of the actions: as the output is one number and rows do not depend on one another, its gradient is worked out on
    /// the way forward, while a tile's activations are at hand, and scaled on the way back.
    Actions(Unit),
    /// Of the weights: activations are kept for the way back, which leaves the gradient with the weights.
    Weights(Arc<KeptGradient>, Lent),
}

/// ∂Q_k/∂a, `K × rows × a`.
#[derive(Default)]
struct Unit(std::sync::OnceLock<Vec<f32>>);

/// The custom operation of (weights, observations, actions).
struct Outputs {
    shape: EnsembleShape,
    layers: Arc<Layers>,
    own_actions: bool,
    rounded: Option<Arc<Vec<[Rounded; 2]>>>,
    gradient: Gradient,
}

impl Outputs {
    fn network<'a>(&'a self, weights: &'a [f32], k: usize) -> Network<'a> {
        let rounded = self.rounded.as_ref().and_then(|rounded| rounded.get(k));
        Network::new(weights, &self.layers, k, self.shape.dims()).with_rounded(rounded)
    }

    /// The actions that member k is asked about.
    fn actions_of<'a>(&self, actions: &'a [f32], k: usize, rows: usize) -> &'a [f32] {
        let len = rows * self.shape.action_dim;
        if self.own_actions { &actions[k * len..][..len] } else { actions }
    }

    fn forward(&self, weights: &[f32], observations: &[f32], actions: &[f32], repeat: usize, out: &mut [f32]) {
        let EnsembleShape { members, observation_dim, action_dim, hidden, outputs } = self.shape;
        let rows = out.len() / (members * outputs);
        let states = (TILE / repeat).max(1);
        let tile = states * repeat;
        out.par_chunks_mut(rows * outputs).enumerate().for_each(|(k, out)| {
            let (network, actions) = (self.network(weights, k), self.actions_of(actions, k, rows));
            out.par_chunks_mut(tile * outputs).enumerate().for_each(|(i, out)| {
                let observations = part(observations, i * states, states, observation_dim);
                let actions = part(actions, i * tile, tile, action_dim);
                with_workspace(|work| {
                    let len = observations.len() / observation_dim * hidden;
                    work.with_base(len, 0, |base, _, work| {
                        network.state_part(observations, base);
                        network.forward(Input { base, repeat, shift: network.bias(0), actions }, work, out);
                    });
                });
            });
        });
    }

    /// Also `unit[K × rows × a] = ∇_a Q_k(s, a)`.
    fn forward_with_slopes(
        &self,
        weights: &[f32],
        observations: &[f32],
        actions: &[f32],
        repeat: usize,
        out: &mut [f32],
        unit: &mut [f32],
    ) {
        let EnsembleShape { members, observation_dim, action_dim, hidden, .. } = self.shape;
        let rows = out.len() / members;
        let states = (TILE / repeat).max(1);
        let tile = states * repeat;
        let both = out.par_chunks_mut(rows).zip(unit.par_chunks_mut(rows * action_dim));
        both.enumerate().for_each(|(k, (out, unit))| {
            let (network, actions) = (self.network(weights, k), self.actions_of(actions, k, rows));
            let tiles = out.par_chunks_mut(tile).zip(unit.par_chunks_mut(tile * action_dim));
            tiles.enumerate().for_each(|(i, (out, unit))| {
                let observations = part(observations, i * states, states, observation_dim);
                let actions = part(actions, i * tile, tile, action_dim);
                with_workspace(|work| {
                    let len = observations.len() / observation_dim * hidden;
                    work.with_base(len, out.len(), |base, ones, work| {
                        network.state_part(observations, base);
                        let input = Input { base, repeat, shift: network.bias(0), actions };
                        let (mut left, scratch) = work.activations(out.len() * hidden);
                        network.forward_recorded(input, &mut left, scratch, out);
                        ones.fill(1.0);
                        let (mut left, scratch) = work.activations(out.len() * hidden);
                        network.backward(ones, &mut left.slope, scratch);
                        network.action_gradient(left.slope[0], unit);
                    });
                });
            });
        });
    }

    fn forward_recorded(&self, weights: &[f32], observations: &[f32], actions: &[f32], lent: &Lent, out: &mut [f32]) {
        let EnsembleShape { members, observation_dim, action_dim, hidden, outputs } = self.shape;
        let mut record = lent.record.lock().unwrap_or_else(PoisonError::into_inner);
        record.resize(members, out.len() / (members * outputs), hidden);
        record.tiles(out).into_par_iter().for_each(|mut tile| {
            let network = self.network(weights, tile.member);
            let observations = part(observations, tile.index * TILE, TILE, observation_dim);
            let actions = part(actions, tile.index * TILE, TILE, action_dim);
            with_workspace(|work| {
                work.with_base(observations.len() / observation_dim * hidden, 0, |base, _, work| {
                    network.state_part(observations, base);
                    let input = Input { base, repeat: 1, shift: network.bias(0), actions };
                    network.forward_recorded(input, &mut tile.activations, work.scratch(), tile.out);
                });
            });
        });
    }

    fn weight_gradient(
        &self,
        weights: &[f32],
        input: &[f32],
        output_gradient: &[f32],
        lent: &Lent,
        gradient: &mut [f32],
    ) {
        let mut record = lent.record.lock().unwrap_or_else(PoisonError::into_inner);
        let mut of_tiles = output_gradient.to_vec();
        record.tiles(&mut of_tiles).into_par_iter().for_each(|mut tile| {
            let network = self.network(weights, tile.member);
            with_workspace(|work| network.backward(tile.out, &mut tile.activations.slope, work.scratch()));
        });
        record.weight_gradients(self.layers.split_mut(gradient), input, output_gradient);
    }
}

impl CustomOp3 for Outputs {
    fn name(&self) -> &'static str {
        "ensemble"
    }

    fn cpu_fwd(
        &self,
        weights: &CpuStorage,
        weights_layout: &candle_core::Layout,
        observations: &CpuStorage,
        observations_layout: &candle_core::Layout,
        actions: &CpuStorage,
        actions_layout: &candle_core::Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let EnsembleShape { members, action_dim, outputs, .. } = self.shape;
        let dims = actions_layout.dims();
        let (states, rows) = (observations_layout.dims()[0], dims[dims.len() - 2]);
        let weights = slice(weights, weights_layout)?;
        let (observations, actions) = (slice(observations, observations_layout)?, slice(actions, actions_layout)?);
        let mut out = vec![0.0; members * rows * outputs];
        let repeat = rows / states;
        match &self.gradient {
            Gradient::None => self.forward(weights, observations, actions, repeat, &mut out),
            Gradient::Actions(unit) => {
                let mut slopes = vec![0.0; members * rows * action_dim];
                self.forward_with_slopes(weights, observations, actions, repeat, &mut out, &mut slopes);
                unit.0.set(slopes).ok();
            }
            Gradient::Weights(_, lent) => self.forward_recorded(weights, observations, actions, lent, &mut out),
        }
        Ok((CpuStorage::F32(out), (members, rows, outputs).into()))
    }

    fn bwd(
        &self,
        weights: &Tensor,
        observations: &Tensor,
        actions: &Tensor,
        _outputs: &Tensor,
        output_gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        match &self.gradient {
            Gradient::None => Ok((None, None, None)),
            Gradient::Actions(unit) => {
                let Some(unit) = unit.0.get() else { bail!("the way back comes before the way forward") };
                let dims = (self.shape.members, output_gradient.dim(1)?, self.shape.action_dim);
                let each = Tensor::from_slice(unit, dims, actions.device())?.broadcast_mul(output_gradient)?;
                Ok((None, None, Some(if self.own_actions { each } else { each.sum(0)? })))
            }
            Gradient::Weights(kept, lent) => {
                let input =
                    read(observations, |s: &[f32]| read(actions, |a: &[f32]| concatenate(s, a, self.shape.dims())))??;
                let output_gradient = output_gradient.contiguous()?;
                read(weights, |weights: &[f32]| {
                    read(&output_gradient, |output_gradient: &[f32]| {
                        kept.write(|gradient| self.weight_gradient(weights, &input, output_gradient, lent, gradient))
                    })
                })???;
                Ok((None, None, None))
            }
        }
    }
}
