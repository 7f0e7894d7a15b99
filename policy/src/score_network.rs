//! The noise predictor of SfBC, ε_θ(a_t, s, t) in continuous time: residual blocks that narrow, then widen again and see what
//! the narrowing ones made. A score is −ε_θ/σ_t.

use crate::dense::Dense;
use crate::dpm_solver::DpmSolver;
use crate::mlp_config::MlpConfig;
use crate::weighted::Weighted;
use crate::weights::{Layout, Part, Weights};
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
    /// Widths of the narrowing blocks; the last is also that of the middle block, and of what state and time become. It has
    /// no norm.
    pub layers: MlpConfig,
}

/// A block: f(x·W + b) plus what state and time add; then the same again, plus the block's input.
struct Block {
    first: Dense,
    condition: Dense,
    second: Dense,
    /// The input in the output's width, if it has another.
    skip: Option<Dense>,
}

/// All layers.
struct Layers {
    state: Dense,
    time: Dense,
    mix: [Dense; 2],
    down: Vec<Block>,
    middle: Block,
    up: Vec<Block>,
    last: Dense,
    layout: Layout,
}

impl Layers {
    fn new(shape: &ScoreShape) -> Self {
        let MlpConfig { hidden: widths, activation, initial, .. } = &shape.layers;
        let (mut parts, mut start): (Vec<Part>, usize) = (Vec::new(), 0);
        let mut layer = |name: &str, inputs, outputs, is_active: bool| {
            let layer = Dense::new(start, inputs, outputs, is_active.then_some(*activation));
            start = layer.range().end;
            parts.extend(layer.parts(name, *initial));
            layer
        };
        let narrowest = widths.last().copied().unwrap_or(1);
        let state = layer("state", shape.observation_dim, EMBEDDING, true);
        let time = layer("time", EMBEDDING, EMBEDDING, false);
        let mix = [layer("mix.0", 2 * EMBEDDING, narrowest, true), layer("mix.1", narrowest, narrowest, true)];
        let mut block = |name: &str, inputs, outputs| Block {
            first: layer(&format!("{name}.first"), inputs, outputs, true),
            condition: layer(&format!("{name}.condition"), narrowest, outputs, false),
            second: layer(&format!("{name}.second"), outputs, outputs, true),
            skip: (inputs != outputs).then(|| layer(&format!("{name}.skip"), inputs, outputs, false)),
        };
        let mut width = shape.action_dim;
        let mut narrow = |(i, outputs): (usize, &usize)| {
            let block = block(&format!("down.{i}"), width, *outputs);
            width = *outputs;
            block
        };
        let down = widths.iter().enumerate().map(&mut narrow).collect();
        let middle = block("middle", narrowest, narrowest);
        // Each sees the block before it and the narrowing block of that width, and is as wide as the one above that.
        let widening = widths.windows(2).rev().enumerate();
        let up = widening.map(|(i, pair)| block(&format!("up.{i}"), 2 * pair[1], pair[0])).collect();
        let last = layer("last", 2 * widths.first().copied().unwrap_or(1), shape.action_dim, false);
        Self { state, time, mix, down, middle, up, last, layout: Layout::new(parts) }
    }
}

/// A noise predictor in continuous time, and its weights.
pub struct ScoreNetwork {
    shape: ScoreShape,
    layers: Arc<Layers>,
    weights: Weights,
    /// Fixed random frequencies, `[16]`.
    frequencies: Tensor,
}

impl ScoreShape {
    /// Frequencies of a network.
    pub const FREQUENCIES: usize = FREQUENCIES;

    /// Tensors of the network's layers, each with `.kernel` `[in, out]` and `.bias` `[out]`.
    pub fn layout(&self) -> Layout {
        Layers::new(self).layout
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
    pub(crate) fn memory(&self, states: u128, rows: u128) -> u128 {
        let (widths, widest) = (&self.layers.hidden, self.layers.widest());
        // What narrowing blocks made; and of a block its input, which is two outputs side by side, and three steps to its output.
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
        Self { layers: Arc::new(Layers::new(&shape)), shape, weights, frequencies }
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
        let (shape, layers, frequencies) = (self.shape.clone(), self.layers.clone(), self.frequencies.clone());
        Self { shape, layers, weights: self.weights.detach(), frequencies }
    }

    /// ε_θ(a_t, s, t), `[rows, a]`: `observations [n, o]` and `t` (n of them) of states, `actions [rows, a]`, where equally many
    /// consecutive rows share a state. Differentiable in the weights.
    pub fn predict(&self, observations: &Tensor, actions: &Tensor, t: &[f64]) -> Result<Tensor> {
        let (layers, n, rows) = (&*self.layers, observations.dim(0)?, actions.dim(0)?);
        if n == 0 || n != t.len() || !rows.is_multiple_of(n) {
            bail!("a noise predictor got {n} states, {} times and {rows} actions", t.len());
        }
        let dense = |layer: &Dense, x: &Tensor, added: Option<&Tensor>| layer.forward(&self.weights, x, added);
        let of_time = dense(&layers.time, &self.time_features(t, observations.device())?, None)?;
        let condition = Tensor::cat(&[&dense(&layers.state, observations, None)?, &of_time], 1)?;
        let condition = layers.mix.iter().try_fold(condition, |x, layer| dense(layer, &x, None))?;
        let block = |block: &Block, x: &Tensor| {
            let inner = dense(&block.first, x, Some(&dense(&block.condition, &condition, None)?))?;
            match &block.skip {
                Some(skip) => dense(&block.second, &inner, Some(&dense(skip, x, None)?)),
                None => dense(&block.second, &inner, Some(x)),
            }
        };
        let (mut x, mut narrowed) = (actions.clone(), Vec::new());
        for down in &layers.down {
            x = block(down, &x)?;
            narrowed.push(x.clone());
        }
        x = block(&layers.middle, &x)?;
        let mut beside = |x: &Tensor| {
            let before = narrowed.pop();
            Tensor::cat(&[before.as_ref().unwrap_or(x), x], 1)
        };
        for up in &layers.up {
            x = block(up, &beside(&x)?)?;
        }
        dense(&layers.last, &beside(&x)?, None)
    }

    /// Sines of 2π·t·frequency, then the cosines, `[n, 32]`.
    fn time_features(&self, t: &[f64], device: &Device) -> Result<Tensor> {
        let frequencies = self.frequencies.to_vec1::<f32>()?;
        let row = |t: &f64| {
            let angles: Vec<f64> = frequencies.iter().map(|frequency| TAU * t * f64::from(*frequency)).collect();
            angles.iter().map(|x| x.sin()).chain(angles.iter().map(|x| x.cos())).collect::<Vec<_>>()
        };
        let features: Vec<f32> = t.iter().flat_map(row).map(|x| x as f32).collect();
        Tensor::from_vec(features, (t.len(), EMBEDDING), device)
    }

    /// Draws actions `[rows, a]` from standard normal `noise`, `[rows, a]`, in the states of `observations`, `[n, o]`, where equally
    /// many consecutive rows share a state. No gradient flows through them.
    pub fn sample(&self, solver: &DpmSolver, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        let (network, states) = (self.detach(), observations.dim(0)?);
        solver.solve(noise, |x, t| network.predict(observations, x, &vec![t; states]))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::gradient::Gradients;
    use crate::mlp_config::Initial;
    use crate::slices::plainly;
    use quad_kernels::activation::Activation;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn normal(generator: &mut ChaCha8Rng, shape: (usize, usize)) -> Tensor {
        let numbers: Vec<f32> = (0..shape.0 * shape.1).map(|_| StandardNormal.sample(generator)).collect();
        Tensor::from_vec(numbers, shape, &Device::Cpu).unwrap()
    }

    fn network(generator: &mut ChaCha8Rng, hidden: &[usize]) -> ScoreNetwork {
        let layers = MlpConfig { activation: Activation::Silu, initial: Initial::Torch, ..MlpConfig::mish(hidden) };
        let shape = ScoreShape { observation_dim: 5, action_dim: 3, layers };
        let layout = shape.layout();
        let weights = Weights::initial(&layout, generator, &Device::Cpu).unwrap();
        let frequencies = ScoreShape::frequencies(generator).unwrap();
        ScoreNetwork::new(shape, Weights::trainable(layout, &weights).unwrap(), frequencies)
    }

    fn close(fast: &Tensor, plain: &Tensor) {
        assert_eq!(fast.dims(), plain.dims());
        let size = plain.sqr().unwrap().mean_all().unwrap().to_scalar::<f32>().unwrap().sqrt();
        let difference = (fast - plain).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap();
        assert!(difference.to_scalar::<f32>().unwrap() < 1e-4 * size, "{difference} at a size of {size}");
    }

    /// Values and gradients of the fast layers are those of candle's operations; rows fill several tiles and parts, or none.
    #[test]
    fn it_gives_the_plain_values_and_gradients() {
        let generator = &mut ChaCha8Rng::seed_from_u64(0);
        for (hidden, states, repeat) in
            [(&[24, 16, 8][..], 300, 1), (&[16, 32], 40, 7), (&[7], 3, 1), (&[16, 16, 16, 16], 1500, 1)]
        {
            let network = network(generator, hidden);
            let (observations, actions) = (normal(generator, (states, 5)), normal(generator, (states * repeat, 3)));
            let t: Vec<f64> = (1..=states).map(|i| i as f64 / states as f64).collect();
            let predict = || network.predict(&observations, &actions, &t).unwrap();
            let (fast, plain) = (predict(), plainly(predict));
            close(&fast, &plain);
            let gradient = |predicted: &Tensor| {
                let loss = (predicted - &actions).unwrap().sqr().unwrap().sum_all().unwrap();
                Gradients::of(&loss).unwrap().with_respect_to(network.weights()).unwrap().copy().unwrap()
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
        let each = crate::plain::repeat_rows(&observations, 3).unwrap();
        close(&shared, &network.sample(&solver, &each, &noise).unwrap());
        assert!(network.predict(&observations, &noise, &[0.5; 3]).is_err(), "a time for each state");
        assert!(network.predict(&observations, &normal(generator, (5, 3)), &[0.5; 4]).is_err());
    }
}
