//! The noise predictor of SfBC, ε_θ(a_t, s, t) in continuous time: residual blocks that narrow,
//! then widen again and see what the narrowing ones made. A score is −ε_θ/σ_t.

use crate::layers::config::MlpConfig;
use crate::score::dense::Dense;
use crate::score::dense_graph::{DenseGraph, Step};
use crate::score::dpm_solver::DpmSolver;
use crate::weighted::Weighted;
use crate::weights::{Layout, TensorSpec, Weights};
use candle_core::{Device, Result, Tensor, bail};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use std::f64::consts::TAU;
use std::sync::Arc;

/// Random frequencies, each with a sine and a cosine of t.
const FREQUENCIES: usize = 16;
/// Their standard deviation.
const SPREAD: f32 = 30.0;
/// Numbers that the state becomes, and the time.
const EMBEDDING: usize = 2 * FREQUENCIES;

/// The shape of such a network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ScoreShape {
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a.
    pub action_dim: usize,
    /// Widths of the narrowing blocks; the last is also that of the middle block, and of what state
    /// and time become. It has no norm.
    pub layers: MlpConfig,
}

/// The layers while they are put together.
struct Builder<'a> {
    layers: &'a MlpConfig,
    parts: Vec<TensorSpec>,
    start: usize,
    steps: Vec<Step>,
}

impl Builder<'_> {
    /// The number of the next value; numbers 0 to 2 are the inputs.
    fn next(&self) -> usize {
        3 + self.steps.len()
    }

    /// A layer, whose weights come behind those of the layers before it.
    fn dense(&mut self, name: &str, (inputs, outputs): (usize, usize), active: bool) -> Dense {
        let layer =
            Dense::new(self.start, inputs, outputs, active.then_some(self.layers.activation));
        self.start = layer.range().end;
        self.parts.extend(layer.parts(name, self.layers.initial));
        layer
    }

    /// Applies a layer to value number `x`, and adds value number `added`. Gives the number of what
    /// comes out.
    fn apply(&mut self, layer: Dense, x: usize, added: Option<usize>) -> usize {
        self.steps.push(Step::Dense { layer, x, added });
        self.next() - 1
    }

    fn layer(&mut self, name: &str, x: usize, sizes: (usize, usize), active: bool) -> usize {
        let layer = self.dense(name, sizes, active);
        self.apply(layer, x, None)
    }

    fn beside(&mut self, one: usize, other: usize) -> usize {
        self.steps.push(Step::Beside(one, other));
        self.next() - 1
    }

    /// A block: f(x·W + b) plus what state and time add, value number `condition` of width
    /// `of_condition`; then the same again, plus the block's input, in the output's width.
    fn block(
        &mut self,
        name: &str,
        x: usize,
        (inputs, outputs): (usize, usize),
        (condition, of_condition): (usize, usize),
    ) -> usize {
        let first = self.dense(&format!("{name}.first"), (inputs, outputs), true);
        let of_condition = self.dense(&format!("{name}.condition"), (of_condition, outputs), false);
        let second = self.dense(&format!("{name}.second"), (outputs, outputs), true);
        let added = self.apply(of_condition, condition, None);
        let inner = self.apply(first, x, Some(added));
        let skip = match inputs == outputs {
            true => x,
            false => {
                let skip = self.dense(&format!("{name}.skip"), (inputs, outputs), false);
                self.apply(skip, x, None)
            }
        };
        self.apply(second, inner, Some(skip))
    }
}

/// The network of (state, features of time, actions), and the layout of its weights.
fn build(shape: &ScoreShape) -> (DenseGraph, Layout) {
    let (layers, a) = (&shape.layers, shape.action_dim);
    let (widths, mut of) =
        (&layers.hidden, Builder { layers, parts: Vec::new(), start: 0, steps: Vec::new() });
    let narrowest = widths.last().copied().unwrap_or(1);
    let state = of.layer("state", 0, (shape.observation_dim, EMBEDDING), true);
    let time = of.layer("time", 1, (EMBEDDING, EMBEDDING), false);
    let both = of.beside(state, time);
    let mixed = of.layer("mix.0", both, (2 * EMBEDDING, narrowest), true);
    let condition = (of.layer("mix.1", mixed, (narrowest, narrowest), true), narrowest);
    let (mut x, mut width, mut narrowed) = (2, a, Vec::new());
    for (i, outputs) in widths.iter().enumerate() {
        x = of.block(&format!("down.{i}"), x, (width, *outputs), condition);
        width = *outputs;
        narrowed.push(x);
    }
    x = of.block("middle", x, (narrowest, narrowest), condition);
    // Each sees the block before it and the narrowing block of that width, and is as wide as the
    // one above that.
    for (i, pair) in widths.windows(2).rev().enumerate() {
        let both = of.beside(narrowed.pop().unwrap_or(x), x);
        x = of.block(&format!("up.{i}"), both, (2 * pair[1], pair[0]), condition);
    }
    let both = of.beside(narrowed.pop().unwrap_or(x), x);
    of.layer("last", both, (2 * widths.first().copied().unwrap_or(1), a), false);
    (
        DenseGraph::new(vec![shape.observation_dim, EMBEDDING, a], of.steps, of.start),
        Layout::new(of.parts),
    )
}

/// A noise predictor in continuous time, and its weights.
pub struct ScoreNetwork {
    shape: ScoreShape,
    graph: Arc<DenseGraph>,
    weights: Weights,
    /// Fixed random frequencies, `[16]`.
    frequencies: Tensor,
}

impl ScoreShape {
    /// Frequencies of a network.
    pub const FREQUENCIES: usize = FREQUENCIES;

    /// Tensors of the network's layers, each with `.kernel` `[in, out]` and `.bias` `[out]`.
    pub fn layout(&self) -> Layout {
        build(self).1
    }

    /// Frequencies to begin with, `[16]`: normal, with a standard deviation of 30.
    ///
    /// # Errors
    /// Candle fails.
    pub fn frequencies(generator: &mut impl Rng) -> Result<Tensor> {
        let one = |_| SPREAD * Distribution::<f32>::sample(&StandardNormal, generator);
        Tensor::from_iter((0..FREQUENCIES).map(one), &Device::Cpu)
    }

    /// Numbers that a forward pass holds at once at most.
    pub fn memory(&self, states: u128, rows: u128) -> u128 {
        let (widths, widest) = (&self.layers.hidden, self.layers.widest());
        // What narrowing blocks made; and of a block its input, which is two outputs side by side,
        // and three steps to its output.
        let of_row = widths.iter().sum::<usize>() + 6 * widest;
        let of_state = 4 * EMBEDDING + 4 * widest;
        rows * of_row as u128 + states * of_state as u128
    }
}

impl Weighted for ScoreNetwork {
    fn weights(&self) -> &Weights {
        &self.weights
    }

    fn weights_mut(&mut self) -> &mut Weights {
        &mut self.weights
    }
}

impl ScoreNetwork {
    /// `weights` are of the shape's layout; `frequencies` `[16]` on the CPU.
    pub fn new(shape: ScoreShape, weights: Weights, frequencies: Tensor) -> Self {
        Self { graph: Arc::new(build(&shape).0), shape, weights, frequencies }
    }

    /// Its shape.
    pub fn shape(&self) -> &ScoreShape {
        &self.shape
    }

    /// Its frequencies, `[16]`.
    pub fn frequencies(&self) -> &Tensor {
        &self.frequencies
    }

    /// Makes constants of the weights; they share the memory of this network.
    pub fn detach(&self) -> Self {
        let (shape, graph, frequencies) =
            (self.shape.clone(), self.graph.clone(), self.frequencies.clone());
        Self { shape, graph, weights: self.weights.detach(), frequencies }
    }

    /// ε_θ(a_t, s, t), `[rows, a]`: `observations [n, o]` and `t` (n of them) of states, `actions
    /// [rows, a]`, where equally many consecutive rows share a state. Differentiable in the
    /// weights.
    pub fn predict(&self, observations: &Tensor, actions: &Tensor, t: &[f64]) -> Result<Tensor> {
        let (n, rows) = (observations.dim(0)?, actions.dim(0)?);
        if n == 0 || n != t.len() || !rows.is_multiple_of(n) {
            bail!("a noise predictor got {n} states, {} times and {rows} actions", t.len());
        }
        let time = self.time_features(t, observations.device())?;
        self.graph.forward(&self.weights, &[observations.clone(), time, actions.clone()])
    }

    /// Sines of 2π·t·frequency, then the cosines, `[n, 32]`.
    fn time_features(&self, t: &[f64], device: &Device) -> Result<Tensor> {
        let frequencies = self.frequencies.to_vec1::<f32>()?;
        let row = |t: &f64| {
            let angles: Vec<f64> =
                frequencies.iter().map(|frequency| TAU * t * f64::from(*frequency)).collect();
            angles.iter().map(|x| x.sin()).chain(angles.iter().map(|x| x.cos())).collect::<Vec<_>>()
        };
        let features: Vec<f32> = t.iter().flat_map(row).map(|x| x as f32).collect();
        Tensor::from_vec(features, (t.len(), EMBEDDING), device)
    }

    /// Draws actions `[rows, a]` from standard normal `noise`, `[rows, a]`, in the states of
    /// `observations`, `[n, o]`, where equally many consecutive rows share a state. No gradient
    /// flows through them.
    pub fn sample(
        &self,
        solver: &DpmSolver,
        observations: &Tensor,
        noise: &Tensor,
    ) -> Result<Tensor> {
        let (network, states) = (self.detach(), observations.dim(0)?);
        solver.solve(noise, |x, t| network.predict(observations, x, &vec![t; states]))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::gradients::gradient::Gradients;
    use crate::layers::config::Initial;
    use crate::slices::plainly;
    use quad_kernels::activation::Activation;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn normal(generator: &mut ChaCha8Rng, shape: (usize, usize)) -> Tensor {
        let numbers: Vec<f32> =
            (0..shape.0 * shape.1).map(|_| StandardNormal.sample(generator)).collect();
        Tensor::from_vec(numbers, shape, &Device::Cpu).unwrap()
    }

    fn network(generator: &mut ChaCha8Rng, hidden: &[usize]) -> ScoreNetwork {
        let layers = MlpConfig {
            activation: Activation::Silu,
            initial: Initial::Torch,
            ..MlpConfig::mish(hidden)
        };
        let shape = ScoreShape { observation_dim: 5, action_dim: 3, layers };
        let layout = shape.layout();
        let weights = Weights::initial(&layout, generator, &Device::Cpu).unwrap();
        let frequencies = ScoreShape::frequencies(generator).unwrap();
        ScoreNetwork::new(shape, Weights::trainable(layout, &weights).unwrap(), frequencies)
    }

    fn close(fast: &Tensor, plain: &Tensor) {
        assert_eq!(fast.dims(), plain.dims());
        let size = plain.sqr().unwrap().mean_all().unwrap().to_scalar::<f32>().unwrap().sqrt();
        let difference =
            (fast - plain).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap();
        assert!(
            difference.to_scalar::<f32>().unwrap() < 1e-4 * size,
            "{difference} at a size of {size}"
        );
    }

    /// Values and gradients of the fast layers are those of candle's operations; rows fill several
    /// tiles and parts, or none.
    #[test]
    fn it_gives_the_plain_values_and_gradients() {
        let generator = &mut ChaCha8Rng::seed_from_u64(0);
        for (hidden, states, repeat) in [
            (&[24, 16, 8][..], 300, 1),
            (&[16, 32], 40, 7),
            (&[7], 3, 1),
            (&[16, 16, 16, 16], 1500, 1),
        ] {
            let network = network(generator, hidden);
            let (observations, actions) =
                (normal(generator, (states, 5)), normal(generator, (states * repeat, 3)));
            let t: Vec<f64> = (1..=states).map(|i| i as f64 / states as f64).collect();
            let predict = || network.predict(&observations, &actions, &t).unwrap();
            let (fast, plain) = (predict(), plainly(predict));
            close(&fast, &plain);
            let gradient = |predicted: &Tensor| {
                let loss = (predicted - &actions).unwrap().sqr().unwrap().sum_all().unwrap();
                Gradients::of(&loss)
                    .unwrap()
                    .with_respect_to(network.weights())
                    .unwrap()
                    .copy()
                    .unwrap()
            };
            close(&gradient(&fast), &gradient(&plain));
            close(&network.detach().predict(&observations, &actions, &t).unwrap(), &plain);
        }
    }

    /// Rows of one state are what they would be if each had the state to itself.
    #[test]
    fn states_are_shared_by_consecutive_rows() {
        let generator = &mut ChaCha8Rng::seed_from_u64(1);
        let (network, observations) = (network(generator, &[16, 8]), normal(generator, (4, 5)));
        let noise = normal(generator, (12, 3));
        let solver = DpmSolver::new(4);
        let shared = network.sample(&solver, &observations, &noise).unwrap();
        let each = crate::layers::plain::repeat_rows(&observations, 3).unwrap();
        close(&shared, &network.sample(&solver, &each, &noise).unwrap());
        assert!(
            network.predict(&observations, &noise, &[0.5; 3]).is_err(),
            "a time for each state"
        );
        assert!(network.predict(&observations, &normal(generator, (5, 3)), &[0.5; 4]).is_err());
    }
}
