//! The noise predictor ε_θ(a^t, s, t) and the sampler that denoises with it.
//!
//! On the CPU two custom operations of candle's do the work: one predicts, with a way back to the weights; the other
//! runs the whole reverse process, tile by tile, so that activations stay in a core's cache.

use crate::layers::{LayerMut, Layers};
use crate::network::{Input, Network, TILE, Workspace, part, with_workspace};
use crate::plain;
use crate::record::{Lent, Pool, Record, concatenate};
use crate::rounded::RoundedOnce;
use crate::slices::{has_fast_body, read, slice};
use crate::weights::{KeptGradient, Layout, Tensors, Weights};
use crate::{Precision, Schedule};
use candle_core::{CpuStorage, CustomOp3, D, DType, Result, Shape, Tensor, bail};
use quad_kernels::activation::{column_sums, mish_slope, multiply};
use quad_kernels::product::{Rounded, outer, product, product_transposed};
use rayon::prelude::*;
use std::sync::{Arc, OnceLock};

/// Size of the sinusoidal features of a denoising step.
const TIME_FEATURES: usize = 16;
/// Width of the network that embeds them, and of its output.
const TIME_EMBEDDING: usize = 32;

/// The shape of a noise predictor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NoiseShape {
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a.
    pub action_dim: usize,
    /// Width of the three hidden layers.
    pub hidden: usize,
    /// Denoising steps T.
    pub diffusion_steps: usize,
}

impl NoiseShape {
    fn time_layers(&self) -> Layers {
        Layers::new(1, &[TIME_FEATURES, TIME_EMBEDDING, TIME_EMBEDDING], 0)
    }

    fn trunk_layers(&self) -> Layers {
        let Self { observation_dim, action_dim, hidden, .. } = *self;
        let input = observation_dim + action_dim + TIME_EMBEDDING;
        Layers::new(1, &[input, hidden, hidden, hidden, action_dim], self.time_layers().end())
    }

    /// Tensors `time.{0,1}` and `trunk.{0..3}`, each with `.kernel` `[in, out]` and `.bias` `[out]`.
    pub fn layout(&self) -> Layout {
        let mut parts = self.time_layers().named("time.", false);
        parts.extend(self.trunk_layers().named("trunk.", false));
        Layout::new(parts)
    }
}

/// A noise predictor and its weights.
pub struct NoisePredictor {
    parts: Arc<Parts>,
    weights: Weights,
    precision: Precision,
    rounded: RoundedOnce<Option<[Rounded; 2]>>,
    records: Pool<Record>,
}

/// What does not change in training.
struct Parts {
    shape: NoiseShape,
    time: Layers,
    trunk: Layers,
    schedule: Schedule,
    /// Sinusoids of t = 1..T, `T × 16`.
    features: Vec<f32>,
}

/// The time embedding for all t: everything but the state and the action in the trunk's first pre-activation.
struct TimeEmbedding {
    /// `T × 32`: behind the activation between the two layers, its slope, and the embedding.
    hidden: Vec<f32>,
    slope: Vec<f32>,
    embedding: Vec<f32>,
    /// `T × hidden`: embedding · kernel_t + bias.
    shift: Vec<f32>,
}

/// cos(t·f_k), then sin(t·f_k), with f_k = exp(-k·ln(10000)/7) for k = 0..7, of t = 1..T.
fn time_features(steps: usize) -> Vec<f32> {
    let half = TIME_FEATURES / 2;
    let angle = |t: usize, k: usize| t as f64 * (-(k as f64) * 10_000_f64.ln() / (half - 1) as f64).exp();
    let row = |t| (0..half).map(move |k| angle(t, k).cos()).chain((0..half).map(move |k| angle(t, k).sin()));
    (1..=steps).flat_map(row).map(|x| x as f32).collect()
}

impl NoisePredictor {
    /// `weights` are of the shape's layout; `precision` is for what no gradient is taken of.
    pub fn new(shape: NoiseShape, weights: Weights, precision: Precision) -> Self {
        let parts = Parts {
            shape,
            time: shape.time_layers(),
            trunk: shape.trunk_layers(),
            schedule: Schedule::variance_preserving(shape.diffusion_steps),
            features: time_features(shape.diffusion_steps),
        };
        let (rounded, records) = (RoundedOnce::default(), Pool::default());
        Self { parts: Arc::new(parts), weights, precision, rounded, records }
    }

    /// Its weights.
    pub fn weights(&self) -> &Weights {
        &self.weights
    }

    /// Its weights, to be changed.
    pub fn weights_mut(&mut self) -> &mut Weights {
        &mut self.weights
    }

    /// Its shape.
    pub fn shape(&self) -> NoiseShape {
        self.parts.shape
    }

    /// The noise schedule that it was made for.
    pub fn schedule(&self) -> &Schedule {
        &self.parts.schedule
    }

    /// ε_θ(a^t, s, t): `observations [B, o]`, `actions [B, a]`, `t [B]` (u32, in 1..=T) → `[B, a]`. Gradients flow to the
    /// weights.
    pub fn predict(&self, observations: &Tensor, actions: &Tensor, t: &Tensor) -> Result<Tensor> {
        let weights = self.weights.values();
        if !has_fast_body(weights.device()) || observations.track_op() || actions.track_op() {
            return self.plain_predict(observations, actions, t);
        }
        let gradient = match (weights.track_op(), self.weights.kept_gradient()) {
            (true, Some(kept)) => Some((kept, self.records.lend())),
            _ => None,
        };
        let operation =
            Predict { parts: self.parts.clone(), t: read(t, <[u32]>::to_vec)?, gradient, embedding: OnceLock::new() };
        weights.apply_op3(&observations.contiguous()?, &actions.contiguous()?, operation)
    }

    /// The same network with its weights as constants, which share their memory with these.
    pub fn frozen(&self) -> Self {
        let (parts, weights) = (self.parts.clone(), self.weights.frozen());
        Self { parts, weights, precision: Precision::F32, rounded: RoundedOnce::default(), records: Pool::default() }
    }

    /// Draws actions by the whole reverse process (DDPM), x_0 clipped to [-1, 1] at each step.
    ///
    /// `observations` is `[n, o]`; `noise` is `[T, rows, a]`, standard normal, where equally many consecutive rows share an
    /// observation: first a^T, then the noise of the reverse steps from t = T down to 2. Gives `[rows, a]`, through which no
    /// gradient flows.
    pub fn sample(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        let weights = self.weights.values().detach();
        if !has_fast_body(weights.device()) {
            return self.plain_sample(observations, noise);
        }
        let rounded = match self.precision {
            Precision::F32 => None,
            Precision::Bf16 => Some(self.rounded.get(&self.weights, |weights| self.parts.network(weights).round())?),
        };
        let operation = Sample { parts: self.parts.clone(), rounded };
        weights.apply_op3_no_bwd(&observations.contiguous()?, &noise.contiguous()?, &operation)
    }

    /// [`Self::predict`] in plain candle operations.
    pub(crate) fn plain_predict(&self, observations: &Tensor, actions: &Tensor, t: &Tensor) -> Result<Tensor> {
        let weights = self.weights.layout().split(self.weights.values(), "")?;
        self.plain_predict_with(&weights, observations, actions, t)
    }

    fn plain_predict_with(
        &self,
        weights: &Tensors,
        observations: &Tensor,
        actions: &Tensor,
        t: &Tensor,
    ) -> Result<Tensor> {
        let steps = self.parts.shape.diffusion_steps;
        let features = Tensor::from_slice(&self.parts.features, (steps, TIME_FEATURES), t.device())?;
        let embedding = plain::mlp(weights, "time.", 2, &features)?;
        let time = embedding.index_select(&(t.to_dtype(DType::F32)? - 1.0)?.to_dtype(DType::U32)?, 0)?;
        plain::mlp(weights, "trunk.", 4, &Tensor::cat(&[observations, actions, &time], D::Minus1)?)
    }

    /// [`Self::sample`] in plain candle operations.
    pub(crate) fn plain_sample(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        let weights = self.weights.layout().split(&self.weights.values().detach(), "")?;
        let (steps, rows, _) = noise.dims3()?;
        let observations = plain::repeat_rows(observations, rows / observations.dim(0)?)?;
        let mut actions = noise.get(0)?;
        for t in (1..=steps).rev() {
            let all = Tensor::full(t as u32, rows, noise.device())?;
            let epsilon = self.plain_predict_with(&weights, &observations, &actions, &all)?;
            let z = if t > 1 { Some(noise.get(steps - t + 1)?) } else { None };
            actions = self.schedule().reverse(t, &actions, &epsilon, z.as_ref())?;
        }
        Ok(actions)
    }
}

impl Parts {
    fn network<'a>(&'a self, weights: &'a [f32]) -> Network<'a> {
        Network::new(weights, &self.trunk, 0, (self.shape.observation_dim, self.shape.action_dim))
    }

    /// Embeds every t = 1..T.
    fn embed(&self, weights: &[f32]) -> TimeEmbedding {
        let ((inputs, width), (_, outputs)) = (self.time.shape(0), self.time.shape(1));
        let affine = |x: &[f32], kernel: &[f32], bias: &[f32], k| {
            let mut out = vec![0.0; self.shape.diffusion_steps * bias.len()];
            product(x, kernel, &mut out, k, bias.len());
            out.chunks_exact_mut(bias.len()).for_each(|row| row.iter_mut().zip(bias).for_each(|(x, b)| *x += b));
            out
        };
        let time = |layer| (self.time.kernel(weights, layer, 0), self.time.bias(weights, layer, 0));
        let ((kernel, bias), network) = (time(0), self.network(weights));
        let before = affine(&self.features, kernel, bias, inputs);
        let (mut hidden, mut slope) = (vec![0.0; before.len()], vec![0.0; before.len()]);
        mish_slope(&before, &mut hidden, &mut slope);
        let (kernel, bias) = time(1);
        let embedding = affine(&hidden, kernel, bias, width);
        let shift = affine(&embedding, network.tail_kernel(), network.bias(0), outputs);
        TimeEmbedding { hidden, slope, embedding, shift }
    }

    fn sample(
        &self,
        weights: &[f32],
        rounded: Option<&[Rounded; 2]>,
        observations: &[f32],
        noise: &[f32],
        actions: &mut [f32],
    ) {
        let NoiseShape { observation_dim, action_dim: a, hidden, diffusion_steps: steps } = self.shape;
        let (network, embedding) = (self.network(weights).with_rounded(rounded), self.embed(weights));
        let (all, rows) = (actions.len(), actions.len() / a);
        let repeat = rows / (observations.len() / observation_dim);
        // A small batch is cut finer, so that every thread gets a share.
        let share = rows.div_ceil(rayon::current_num_threads()).clamp(1, TILE);
        let states = (share / repeat).max(1);
        let tile = states * repeat * a;
        actions.par_chunks_mut(tile).enumerate().for_each(|(i, actions)| {
            let observations = part(observations, i * states, states, observation_dim);
            let len = observations.len() / observation_dim * hidden;
            with_workspace(|work| {
                work.with_base(len, actions.len(), |base, epsilon, work| {
                    network.state_part(observations, base);
                    actions.copy_from_slice(&noise[i * tile..][..actions.len()]);
                    for t in (1..=steps).rev() {
                        let shift = &embedding.shift[(t - 1) * hidden..][..hidden];
                        network.forward(Input { base, repeat, shift, actions }, work, epsilon);
                        let z = if t > 1 { &noise[(steps - t + 1) * all + i * tile..][..actions.len()] } else { &[] };
                        self.schedule.reverse_in_place(t, actions, epsilon, z);
                    }
                });
            });
        });
    }

    /// Runs one tile with its own t per row: the state part takes each row's time part along.
    fn with_tile(
        &self,
        (network, embedding): (Network<'_>, &TimeEmbedding),
        (observations, actions, t): (&[f32], &[f32], &[u32]),
        work: &mut Workspace,
        run: impl FnOnce(Input<'_>, &mut Workspace),
    ) {
        let h = self.shape.hidden;
        work.with_base(t.len() * h, 0, |base, _, work| {
            network.state_part(observations, base);
            for (row, t) in base.chunks_exact_mut(h).zip(t) {
                let shift = &embedding.shift[(*t as usize - 1) * h..][..h];
                row.iter_mut().zip(shift).for_each(|(x, s)| *x += s);
            }
            let zero = vec![0.0; h];
            run(Input { base, repeat: 1, shift: &zero, actions }, work);
        });
    }

    /// The way back into the time embedding, once per t rather than once per row: `by_step` is the gradient before the
    /// trunk's first activation, summed by t, `T × hidden`.
    fn time_gradient(
        &self,
        weights: &[f32],
        embedding: &TimeEmbedding,
        by_step: &[f32],
        time: Vec<LayerMut<'_>>,
        tail: &mut [f32],
    ) {
        let ((inputs, width), (_, outputs)) = (self.time.shape(0), self.time.shape(1));
        let (h, steps) = (self.shape.hidden, self.shape.diffusion_steps);
        outer(&embedding.embedding, by_step, tail, outputs, h);
        let mut d_embedding = vec![0.0; steps * outputs];
        product_transposed(by_step, self.network(weights).tail_kernel(), &mut d_embedding, outputs, h);
        let mut d_hidden = vec![0.0; steps * width];
        product_transposed(&d_embedding, self.time.kernel(weights, 1, 0), &mut d_hidden, width, outputs);
        multiply(&mut d_hidden, &embedding.slope);
        for LayerMut { layer, kernel, bias, .. } in time {
            let (x, inputs, delta) = match layer {
                0 => (&self.features, inputs, &d_hidden),
                _ => (&embedding.hidden, width, &d_embedding),
            };
            outer(x, delta, kernel, inputs, bias.len());
            column_sums(delta, bias);
        }
    }
}

fn check_shapes(shape: &NoiseShape, observations: &[usize], actions: &[usize]) -> Result<()> {
    let fits = |dims: &[usize], width| dims.len() == 2 && dims[0] > 0 && dims[1] == width;
    if fits(observations, shape.observation_dim)
        && fits(actions, shape.action_dim)
        && actions[0].is_multiple_of(observations[0])
    {
        return Ok(());
    }
    bail!("a noise predictor of {shape:?} got observations {observations:?} and actions {actions:?}")
}

/// The custom operation of (weights, observations, noisy actions).
struct Predict {
    parts: Arc<Parts>,
    t: Vec<u32>,
    gradient: Option<(Arc<KeptGradient>, Lent<Record>)>,
    /// Left by the way forward.
    embedding: OnceLock<TimeEmbedding>,
}

impl Predict {
    fn tile<'a>(&'a self, observations: &'a [f32], actions: &'a [f32], i: usize) -> (&'a [f32], &'a [f32], &'a [u32]) {
        let NoiseShape { observation_dim, action_dim, .. } = self.parts.shape;
        let t = &self.t[i * TILE..((i + 1) * TILE).min(self.t.len())];
        (part(observations, i * TILE, TILE, observation_dim), part(actions, i * TILE, TILE, action_dim), t)
    }

    fn forward(&self, weights: &[f32], observations: &[f32], actions: &[f32], out: &mut [f32]) {
        let of = (self.parts.network(weights), self.embedding.get_or_init(|| self.parts.embed(weights)));
        out.par_chunks_mut(TILE * self.parts.shape.action_dim).enumerate().for_each(|(i, out)| {
            let rows = self.tile(observations, actions, i);
            with_workspace(|work| self.parts.with_tile(of, rows, work, |input, work| of.0.forward(input, work, out)));
        });
    }

    fn forward_recorded(
        &self,
        weights: &[f32],
        observations: &[f32],
        actions: &[f32],
        lent: &Lent<Record>,
        out: &mut [f32],
    ) {
        let of = (self.parts.network(weights), self.embedding.get_or_init(|| self.parts.embed(weights)));
        let mut record = lent.lock();
        record.resize(1, self.t.len(), self.parts.shape.hidden);
        record.tiles(out).into_par_iter().for_each(|mut tile| {
            let rows = self.tile(observations, actions, tile.index);
            with_workspace(|work| {
                self.parts.with_tile(of, rows, work, |input, work| {
                    of.0.forward_recorded(input, &mut tile.activations, work.scratch(), tile.out);
                });
            });
        });
    }

    fn weight_gradient(
        &self,
        weights: &[f32],
        input: &[f32],
        output_gradient: &[f32],
        lent: &Lent<Record>,
        gradient: &mut [f32],
    ) {
        let Parts { shape, time, trunk, .. } = &*self.parts;
        let (network, embedding) =
            (self.parts.network(weights), self.embedding.get_or_init(|| self.parts.embed(weights)));
        let mut record = lent.lock();
        let mut of_tiles = output_gradient.to_vec();
        record.tiles(&mut of_tiles).into_par_iter().for_each(|mut tile| {
            with_workspace(|work| network.backward(tile.out, &mut tile.activations.slope, work.scratch()));
        });
        let (of_time, of_trunk) = gradient.split_at_mut(time.end());
        record.weight_gradients(trunk.split_mut(of_trunk), input, output_gradient);
        let h = shape.hidden;
        let mut by_step = vec![0.0; shape.diffusion_steps * h];
        for (t, delta) in self.t.iter().zip(record.first_delta(0).chunks_exact(h)) {
            by_step[(*t as usize - 1) * h..][..h].iter_mut().zip(delta).for_each(|(sum, d)| *sum += d);
        }
        let tail = &mut of_trunk[(shape.observation_dim + shape.action_dim) * h..][..TIME_EMBEDDING * h];
        self.parts.time_gradient(weights, embedding, &by_step, time.split_mut(of_time), tail);
    }
}

impl CustomOp3 for Predict {
    fn name(&self) -> &'static str {
        "noise-predictor"
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
        let shape = self.parts.shape;
        check_shapes(&shape, observations_layout.dims(), actions_layout.dims())?;
        let known = |t: &u32| (1..=shape.diffusion_steps).contains(&(*t as usize));
        if observations_layout.dims()[0] != self.t.len() || !self.t.iter().all(known) {
            bail!("a denoising step in 1..={} is needed for each row", shape.diffusion_steps);
        }
        let weights = slice(weights, weights_layout)?;
        let (observations, actions) = (slice(observations, observations_layout)?, slice(actions, actions_layout)?);
        let mut out = vec![0.0; actions.len()];
        match &self.gradient {
            None => self.forward(weights, observations, actions, &mut out),
            Some((_, lent)) => self.forward_recorded(weights, observations, actions, lent, &mut out),
        }
        Ok((CpuStorage::F32(out), actions_layout.shape().clone()))
    }

    fn bwd(
        &self,
        weights: &Tensor,
        observations: &Tensor,
        actions: &Tensor,
        _noise: &Tensor,
        output_gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        if let Some((kept, lent)) = &self.gradient {
            let dims = (self.parts.shape.observation_dim, self.parts.shape.action_dim);
            let input = read(observations, |s: &[f32]| read(actions, |a: &[f32]| concatenate(s, a, dims)))??;
            let output_gradient = output_gradient.contiguous()?;
            read(weights, |weights: &[f32]| {
                read(&output_gradient, |output_gradient: &[f32]| {
                    kept.write(|gradient| self.weight_gradient(weights, &input, output_gradient, lent, gradient))
                })
            })???;
        }
        Ok((None, None, None))
    }
}

/// The custom operation of (weights, observations, noise) that draws actions.
struct Sample {
    parts: Arc<Parts>,
    rounded: Option<Arc<Option<[Rounded; 2]>>>,
}

impl CustomOp3 for Sample {
    fn name(&self) -> &'static str {
        "sampler"
    }

    fn cpu_fwd(
        &self,
        weights: &CpuStorage,
        weights_layout: &candle_core::Layout,
        observations: &CpuStorage,
        observations_layout: &candle_core::Layout,
        noise: &CpuStorage,
        noise_layout: &candle_core::Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (steps, rows, a) = noise_layout.shape().dims3()?;
        check_shapes(&self.parts.shape, observations_layout.dims(), &[rows, a])?;
        if steps != self.parts.shape.diffusion_steps {
            bail!("noise for {} denoising steps is needed, not for {steps}", self.parts.shape.diffusion_steps);
        }
        let (observations, noise) = (slice(observations, observations_layout)?, slice(noise, noise_layout)?);
        let mut actions = vec![0.0; rows * a];
        let rounded = self.rounded.as_deref().and_then(Option::as_ref);
        self.parts.sample(slice(weights, weights_layout)?, rounded, observations, noise, &mut actions);
        Ok((CpuStorage::F32(actions), (rows, a).into()))
    }
}
