//! SfBC's noise predictor ε_θ(a_t, s, t) in continuous time, a U-Net of dense residual blocks. The
//! score is −ε_θ/σ_t.

use crate::layers::config::MlpConfig;
use crate::score::dense::Dense;
use crate::score::dense_graph::{DenseGraph, Step};
use crate::score::dpm_solver::DpmSolver;
use crate::weighted::weighted;
use crate::weights::{Layout, TensorSpec, Weights};
use candle_core::{Device, Result, Tensor, bail};
use quad_kernels::Precision;
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use std::f64::consts::TAU;
use std::sync::Arc;

/// Number of random frequencies, each with a sine and a cosine of t.
const FREQUENCIES: usize = 16;
/// Standard deviation of the random frequencies.
const SPREAD: f32 = 30.0;
/// Number of inputs: the state, features of time and the action.
const INPUTS: usize = 3;
/// Length of the embeddings of state and time.
const EMBEDDING: usize = 2 * FREQUENCIES;

/// The shape of a score network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ScoreShape {
    /// Length of an observation s.
    pub observation_dim: usize,
    /// Length of an action a.
    pub action_dim: usize,
    /// Widths of the downward blocks; the last is also that of the middle block and of the
    /// conditioning on state and time. Norms are ignored.
    pub layers: MlpConfig,
}

/// Builds the graph and the layout of its weights.
struct GraphBuilder<'a> {
    layers: &'a MlpConfig,
    precision: Precision,
    specs: Vec<TensorSpec>,
    start: usize,
    steps: Vec<Step>,
}

impl<'a> GraphBuilder<'a> {
    fn new(layers: &'a MlpConfig, precision: Precision) -> Self {
        let (specs, steps) = (Vec::new(), Vec::new());
        Self { layers, precision: precision.in_effect(), specs, start: 0, steps }
    }

    /// Adds a step. Returns the number of its value; the first are the inputs.
    fn step(&mut self, step: Step) -> usize {
        self.steps.push(step);
        INPUTS - 1 + self.steps.len()
    }

    /// The next layer in the vector of weights.
    fn dense(&mut self, name: &str, (inputs, outputs): (usize, usize), active: bool) -> Dense {
        let layer = Dense {
            start: self.start,
            inputs,
            outputs,
            activation: active.then_some(self.layers.activation),
            precision: Precision::F32,
        };
        self.start = layer.range().end;
        self.specs.extend(layer.specs(name, self.layers.initial));
        layer
    }

    /// Adds a step with a layer of value `x`, plus value `added`. Inputs are not rounded.
    fn apply(&mut self, mut layer: Dense, x: usize, added: Option<usize>) -> usize {
        if x >= INPUTS {
            layer.precision = self.precision;
        }
        self.step(Step::Dense { layer, x, added })
    }

    /// A layer of value `x`.
    fn layer(&mut self, name: &str, x: usize, sizes: (usize, usize), active: bool) -> usize {
        let layer = self.dense(name, sizes, active);
        self.apply(layer, x, None)
    }

    /// A residual block: h = f(W₁·x) + W₂·c, then f(W₃·h) + x with a linear map of x to the
    /// output's width. The condition c is a value and its width.
    fn block(
        &mut self,
        name: &str,
        x: usize,
        (inputs, outputs): (usize, usize),
        (c, width): (usize, usize),
    ) -> usize {
        let first = self.dense(&format!("{name}.first"), (inputs, outputs), true);
        let condition = self.dense(&format!("{name}.condition"), (width, outputs), false);
        let second = self.dense(&format!("{name}.second"), (outputs, outputs), true);
        let added = self.apply(condition, c, None);
        let h = self.apply(first, x, Some(added));
        let skip = match inputs == outputs {
            true => x,
            false => self.layer(&format!("{name}.skip"), x, (inputs, outputs), false),
        };
        self.apply(second, h, Some(skip))
    }
}

/// The network of (state, features of time, actions) and the layout of its weights.
fn build(shape: &ScoreShape, precision: Precision) -> (DenseGraph, Layout) {
    let (widths, a) = (&shape.layers.hidden, shape.action_dim);
    let mut builder = GraphBuilder::new(&shape.layers, precision);
    let narrowest = widths.last().copied().unwrap_or(1);
    let state = builder.layer("state", 0, (shape.observation_dim, EMBEDDING), true);
    let time = builder.layer("time", 1, (EMBEDDING, EMBEDDING), false);
    let both = builder.step(Step::Concat(state, time));
    let mixed = builder.layer("mix.0", both, (2 * EMBEDDING, narrowest), true);
    let mixed = builder.layer("mix.1", mixed, (narrowest, narrowest), true);
    let condition = (mixed, narrowest);
    let (mut x, mut width, mut skips) = (2, a, Vec::new());
    for (i, outputs) in widths.iter().enumerate() {
        x = builder.block(&format!("down.{i}"), x, (width, *outputs), condition);
        width = *outputs;
        skips.push(x);
    }
    x = builder.block("middle", x, (narrowest, narrowest), condition);
    // Each block reads the block before it and the downward block of that width.
    for (i, pair) in widths.windows(2).rev().enumerate() {
        let both = builder.step(Step::Concat(skips.pop().unwrap_or(x), x));
        x = builder.block(&format!("up.{i}"), both, (2 * pair[1], pair[0]), condition);
    }
    let both = builder.step(Step::Concat(skips.pop().unwrap_or(x), x));
    let widest = widths.first().copied().unwrap_or(1);
    builder.layer("last", both, (2 * widest, a), false);
    let inputs = vec![shape.observation_dim, EMBEDDING, a];
    let graph = DenseGraph::new(inputs, builder.steps, builder.start);
    (graph, Layout::new(builder.specs))
}

/// A noise predictor in continuous time, and its weights.
pub struct ScoreNetwork {
    shape: ScoreShape,
    graph: Arc<DenseGraph>,
    weights: Weights,
    /// Fixed random frequencies, `[16]`.
    frequencies: Tensor,
}

weighted!(ScoreNetwork);

impl ScoreShape {
    /// Number of random frequencies.
    pub const FREQUENCIES: usize = FREQUENCIES;

    /// Tensors of the layers, each with `.kernel` `[in, out]` and `.bias` `[out]`.
    pub fn layout(&self) -> Layout {
        build(self, Precision::F32).1
    }

    /// Draws frequencies, `[16]`, normal with a standard deviation of 30.
    pub fn frequencies(generator: &mut impl Rng) -> Result<Tensor> {
        let one = |_| SPREAD * Distribution::<f32>::sample(&StandardNormal, generator);
        Tensor::from_iter((0..FREQUENCIES).map(one), &Device::Cpu)
    }

    /// Numbers held by a forward pass.
    pub fn floats(&self, states: u128, rows: u128) -> u128 {
        let (widths, widest) = (&self.layers.hidden, self.layers.widest());
        // Outputs of the downward blocks; and of one block its input, which is two outputs, and
        // three steps.
        let row_floats = widths.iter().sum::<usize>() + 6 * widest;
        let state_floats = 4 * EMBEDDING + 4 * widest;
        rows * row_floats as u128 + states * state_floats as u128
    }
}

impl ScoreNetwork {
    /// A network with weights of the shape's layout and `frequencies` `[16]` on the CPU, whose
    /// products are in this precision.
    pub fn new(
        shape: ScoreShape,
        weights: Weights,
        frequencies: Tensor,
        precision: Precision,
    ) -> Self {
        let graph = Arc::new(build(&shape, precision).0);
        Self { shape, graph, weights, frequencies }
    }

    /// Sizes and blocks.
    pub fn shape(&self) -> &ScoreShape {
        &self.shape
    }

    /// The frequencies, `[16]`.
    pub fn frequencies(&self) -> &Tensor {
        &self.frequencies
    }

    /// The same network with constant weights, in the same memory.
    pub fn detach(&self) -> Self {
        let (shape, frequencies) = (self.shape.clone(), self.frequencies.clone());
        let (graph, weights) = (self.graph.clone(), self.weights.detach());
        Self { shape, graph, weights, frequencies }
    }

    /// ε_θ(a_t, s, t), `[rows, a]`, for `observations [n, o]`, n times `t` and `actions [rows, a]`,
    /// of which the first rows/n belong to the first observation, and so on. Differentiable in the
    /// weights.
    pub fn predict(&self, observations: &Tensor, actions: &Tensor, t: &[f64]) -> Result<Tensor> {
        let (n, rows) = (observations.dim(0)?, actions.dim(0)?);
        if n == 0 || n != t.len() || !rows.is_multiple_of(n) {
            let times = t.len();
            bail!("a noise predictor got {n} states, {times} times and {rows} actions");
        }
        let time = self.time_features(t, observations.device())?;
        let inputs = [observations.clone(), time, actions.clone()];
        self.graph.forward(&self.weights, &inputs)
    }

    /// Sines, then cosines of 2π·t·frequency, `[n, 32]`.
    fn time_features(&self, t: &[f64], device: &Device) -> Result<Tensor> {
        let frequencies = self.frequencies.to_vec1::<f32>()?;
        let mut features = Vec::with_capacity(t.len() * EMBEDDING);
        for t in t {
            for wave in [f64::sin, f64::cos] {
                let angles = frequencies.iter().map(|x| TAU * t * f64::from(*x));
                features.extend(angles.map(|angle| wave(angle) as f32));
            }
        }
        Tensor::from_vec(features, (t.len(), EMBEDDING), device)
    }

    /// Draws actions `[rows, a]` from standard normal `noise`, `[rows, a]`, for `observations`,
    /// `[n, o]`, without gradients.
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
mod tests {
    use super::*;
    use crate::layers::config::InitScheme;
    use crate::slices::plainly;
    use crate::testing::{assert_within, gradient, random, weights};
    use quad_kernels::activation::Activation;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn network(hidden: &[usize]) -> Result<ScoreNetwork> {
        let generator = &mut ChaCha8Rng::seed_from_u64(0);
        let mut layers = MlpConfig::mish(hidden);
        (layers.activation, layers.initial) = (Activation::Silu, InitScheme::Torch);
        let shape = ScoreShape { observation_dim: 5, action_dim: 3, layers };
        let weights = weights(shape.layout(), generator);
        let frequencies = ScoreShape::frequencies(generator)?;
        let precision = Precision::F32;
        Ok(ScoreNetwork::new(shape, weights, frequencies, precision))
    }

    /// Rows fill several tiles and chunks, or none.
    #[test]
    fn fast_values_and_gradients_match_the_plain_ones() -> Result<()> {
        for (hidden, states, repeat) in
            [(&[24, 16, 8][..], 300, 1), (&[16, 32], 40, 7), (&[7], 3, 1), (&[16; 4], 1500, 1)]
        {
            let network = network(hidden)?;
            let observations = random((states, 5), 1);
            let actions = random((states * repeat, 3), 2);
            let t: Vec<f64> = (1..=states).map(|i| i as f64 / states as f64).collect();
            let predict = || network.predict(&observations, &actions, &t);
            let (fast, plain) = (predict()?, plainly(predict)?);
            assert_within(1e-4, "values", &fast, &plain);
            let [fast_gradient, plain_gradient] =
                [fast, plain.clone()].map(|x| gradient(&x, &network.weights));
            assert_within(1e-4, "gradients", &fast_gradient?, &plain_gradient?);
            let constant = network.detach().predict(&observations, &actions, &t)?;
            assert_within(1e-4, "constants", &constant, &plain);
        }
        Ok(())
    }

    #[test]
    fn consecutive_rows_share_a_state() -> Result<()> {
        let (network, solver) = (network(&[16, 8])?, DpmSolver::new(4));
        let (observations, noise) = (random((4, 5), 1), random((12, 3), 2));
        let shared = network.sample(&solver, &observations, &noise)?;
        let each = crate::layers::plain::repeat_rows(&observations, 3)?;
        let each = network.sample(&solver, &each, &noise)?;
        assert_within(1e-4, "samples", &shared, &each);
        let refused = |actions, t| network.predict(&observations, actions, t).is_err();
        assert!(refused(&noise, &[0.5; 3]), "3 times, 4 states");
        assert!(refused(&random((5, 3), 3), &[0.5; 4]), "5 rows");
        Ok(())
    }
}
