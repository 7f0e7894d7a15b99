//! A noise predictor's work on the CPU: custom operations of (weights, observations, actions), cut into tiles of rows that
//! run in parallel. The sampler runs the whole reverse process for a tile, so that activations stay in a core's cache.

use crate::layers::{LayerMut, Layers};
use crate::network::{Input, Network, TILE, Workspace, rows_of, with_workspace};
use crate::operation::{Arguments, Operation};
use crate::saved::{Lent, SavedActivations, concatenate};
use crate::schedule::Schedule;
use crate::shape::{NoiseShape, TIME_EMBEDDING};
use crate::weights::KeptGradient;
use candle_core::{Result, Shape, bail};
use quad_kernels::activation::{column_sums, mish_slope, multiply};
use quad_kernels::product::{Rounded, outer, product, product_transposed};
use rayon::prelude::*;
use std::sync::{Arc, OnceLock};

/// What does not change in training.
pub(crate) struct Parts {
    pub shape: NoiseShape,
    pub time: Layers,
    pub trunk: Layers,
    pub schedule: Schedule,
    /// Sinusoids of t = 1..T, `T × 16`.
    pub features: Vec<f32>,
}

/// The time embedding for all t: everything but the state and the action in the trunk's first pre-activation.
pub(crate) struct TimeEmbedding {
    /// `T × 32`: behind the activation between the two layers, its slope, and the embedding.
    hidden: Vec<f32>,
    slope: Vec<f32>,
    embedding: Vec<f32>,
    /// `T × hidden`: embedding · kernel_t + bias.
    shift: Vec<f32>,
}

impl Parts {
    pub fn network<'a>(&'a self, weights: &'a [f32]) -> Network<'a> {
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
            let observations = rows_of(observations, i * states, states, observation_dim);
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

    /// The backward pass into the time embedding, once per t rather than once per row: `by_step` is the gradient before the
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

fn check_shapes(shape: &NoiseShape, given: &Arguments<'_>) -> Result<()> {
    let NoiseShape { observation_dim, action_dim, .. } = *shape;
    let Arguments { states, rows, .. } = *given;
    let fits =
        states > 0 && rows > 0 && rows.is_multiple_of(states) && given.observations.len() == states * observation_dim;
    if fits && given.actions.len().is_multiple_of(rows * action_dim) {
        return Ok(());
    }
    bail!("a noise predictor of {shape:?} got {states} observations and {rows} actions of another shape")
}

/// The custom operation of (weights, observations, noisy actions).
pub(crate) struct Predict {
    pub parts: Arc<Parts>,
    pub t: Vec<u32>,
    pub gradient: Option<(Arc<KeptGradient>, Lent<SavedActivations>)>,
    /// Left by the forward pass.
    pub embedding: OnceLock<TimeEmbedding>,
}

impl Predict {
    fn tile<'a>(&'a self, observations: &'a [f32], actions: &'a [f32], i: usize) -> (&'a [f32], &'a [f32], &'a [u32]) {
        let NoiseShape { observation_dim, action_dim, .. } = self.parts.shape;
        let t = &self.t[i * TILE..((i + 1) * TILE).min(self.t.len())];
        (rows_of(observations, i * TILE, TILE, observation_dim), rows_of(actions, i * TILE, TILE, action_dim), t)
    }

    /// The network and its time embedding, which the forward pass leaves for the backward pass.
    fn network<'a>(&'a self, weights: &'a [f32]) -> (Network<'a>, &'a TimeEmbedding) {
        (self.parts.network(weights), self.embedding.get_or_init(|| self.parts.embed(weights)))
    }

    fn predict(&self, given: Arguments<'_>, out: &mut [f32]) {
        let of = self.network(given.weights);
        out.par_chunks_mut(TILE * self.parts.shape.action_dim).enumerate().for_each(|(i, out)| {
            let rows = self.tile(given.observations, given.actions, i);
            with_workspace(|work| self.parts.with_tile(of, rows, work, |input, work| of.0.forward(input, work, out)));
        });
    }

    fn predict_saving(&self, given: Arguments<'_>, saved: &mut SavedActivations, out: &mut [f32]) {
        let of = self.network(given.weights);
        saved.resize(1, given.rows, self.parts.shape.hidden);
        saved.tiles(out).into_par_iter().for_each(|mut tile| {
            let rows = self.tile(given.observations, given.actions, tile.index);
            with_workspace(|work| {
                self.parts.with_tile(of, rows, work, |input, work| {
                    of.0.forward_saving(input, &mut tile.activations, work.scratch(), tile.out);
                });
            });
        });
    }

    fn weight_gradient(
        &self,
        given: Arguments<'_>,
        output_gradient: &[f32],
        saved: &mut SavedActivations,
        gradient: &mut [f32],
    ) {
        let Parts { shape, time, trunk, .. } = &*self.parts;
        let (network, embedding) = self.network(given.weights);
        // The copy is cut up; the other is read as a whole.
        saved.tiles(&mut output_gradient.to_vec()).into_par_iter().for_each(|mut tile| {
            with_workspace(|work| network.backward(tile.out, &mut tile.activations.slope, work.scratch()));
        });
        let (of_time, of_trunk) = gradient.split_at_mut(time.end());
        let input = concatenate(given.observations, given.actions, (shape.observation_dim, shape.action_dim));
        saved.weight_gradients(trunk.split_mut(of_trunk), &input, output_gradient);
        let h = shape.hidden;
        let mut by_step = vec![0.0; shape.diffusion_steps * h];
        for (t, delta) in self.t.iter().zip(saved.first_delta(0).chunks_exact(h)) {
            by_step[(*t as usize - 1) * h..][..h].iter_mut().zip(delta).for_each(|(sum, d)| *sum += d);
        }
        let tail = &mut of_trunk[(shape.observation_dim + shape.action_dim) * h..][..TIME_EMBEDDING * h];
        self.parts.time_gradient(given.weights, embedding, &by_step, time.split_mut(of_time), tail);
    }
}

impl Operation for Predict {
    const NAME: &'static str = "noise-predictor";

    fn forward(&self, given: Arguments<'_>) -> Result<(Vec<f32>, Shape)> {
        let shape = self.parts.shape;
        check_shapes(&shape, &given)?;
        let known = |t: &u32| (1..=shape.diffusion_steps).contains(&(*t as usize));
        if [given.states, given.rows] != [self.t.len(); 2] || !self.t.iter().all(known) {
            bail!("a denoising step in 1..={} is needed for each row", shape.diffusion_steps);
        }
        let mut out = vec![0.0; given.actions.len()];
        match &self.gradient {
            None => self.predict(given, &mut out),
            Some((_, lent)) => self.predict_saving(given, &mut lent.lock(), &mut out),
        }
        Ok((out, (given.rows, shape.action_dim).into()))
    }

    fn backward(&self, given: Arguments<'_>, gradient: &[f32]) -> Result<()> {
        let Some((kept, lent)) = &self.gradient else { return Ok(()) };
        kept.write(|out| self.weight_gradient(given, gradient, &mut lent.lock(), out))
    }
}

/// The custom operation of (weights, observations, noise) that draws actions.
pub(crate) struct Sample {
    pub parts: Arc<Parts>,
    pub rounded: Option<Arc<Option<[Rounded; 2]>>>,
}

impl Operation for Sample {
    const NAME: &'static str = "sampler";

    fn forward(&self, given: Arguments<'_>) -> Result<(Vec<f32>, Shape)> {
        let NoiseShape { action_dim, diffusion_steps, .. } = self.parts.shape;
        check_shapes(&self.parts.shape, &given)?;
        let len = given.rows * action_dim;
        if given.actions.len() != diffusion_steps * len {
            bail!("noise for {diffusion_steps} denoising steps is needed, not for {}", given.actions.len() / len);
        }
        let mut actions = vec![0.0; len];
        let rounded = self.rounded.as_deref().and_then(Option::as_ref);
        self.parts.sample(given.weights, rounded, given.observations, given.actions, &mut actions);
        Ok((actions, (given.rows, action_dim).into()))
    }
}
