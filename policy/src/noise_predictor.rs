//! The noise predictor ε_θ(a^t, s, t), its gradient, and the sampler that denoises with it.

use crate::elementwise::{column_sums, mish_slope, multiply};
use crate::ensemble::part;
use crate::matmul::{Rounded, outer, product, product_transposed};
use crate::mlp::Mlp;
use crate::network::{Input, Network, TILE, Workspace, concatenate, with_workspace};
use crate::{Architecture, Precision, Schedule};
use rayon::prelude::*;

/// Shapes and constants of a noise predictor; its parameters are a flat slice: time embedding, then trunk.
#[derive(Clone, Debug)]
pub struct NoisePredictor {
    time: Mlp,
    trunk: Network,
    /// Sinusoids of t = 1..T, `T × 16`.
    features: Vec<f32>,
    schedule: Schedule,
}

/// A noise predictor's hidden kernels as a [`Precision`] wants them; none in f32.
pub struct RoundedActor(Option<[Rounded; 2]>);

/// The time embedding for all t: everything but the state and the action in the trunk's first pre-activation.
struct TimeEmbedding {
    /// `T × 32`, before the activation between the two layers, after it, its slope; and the embedding.
    hidden: Vec<f32>,
    slope: Vec<f32>,
    embedding: Vec<f32>,
    /// `T × hidden`: embedding · kernel_t + bias.
    shift: Vec<f32>,
}

/// What [`NoisePredictor::record`] keeps for the way back.
pub struct Recording {
    embedding: TimeEmbedding,
    /// Activations and slopes, tile by tile.
    tiles: Vec<Workspace>,
}

/// cos(t·f_k), then sin(t·f_k), with f_k = exp(-k·ln(10000)/7) for k = 0..7.
fn time_features(steps: usize, size: usize) -> Vec<f32> {
    let half = size / 2;
    let angle = |t: usize, k: usize| t as f64 * (-(k as f64) * 10_000_f64.ln() / (half - 1) as f64).exp();
    let row = |t| (0..half).map(move |k| angle(t, k).cos()).chain((0..half).map(move |k| angle(t, k).sin()));
    (1..=steps).flat_map(row).map(|x| x as f32).collect()
}

/// Noisy actions of a batch, one per state, with their denoising steps.
#[derive(Clone, Copy, Debug)]
pub struct NoisyActions<'a> {
    /// `batch × observation_dim`.
    pub observations: &'a [f32],
    /// a^t, `batch × action_dim`.
    pub actions: &'a [f32],
    /// t in 1..=T for each.
    pub t: &'a [usize],
}

impl NoisePredictor {
    /// The noise predictor of an architecture.
    pub fn new(architecture: &Architecture) -> Self {
        let trunk = Network {
            mlp: Mlp::new(&architecture.trunk_widths()),
            observation_dim: architecture.observation_dim,
            action_dim: architecture.action_dim,
            hidden: architecture.hidden,
        };
        let time = Mlp::new(&architecture.time_widths());
        let features = time_features(architecture.diffusion_steps, time.shape(0).0);
        Self { time, trunk, features, schedule: Schedule::variance_preserving(architecture.diffusion_steps) }
    }

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        self.time.len() + self.trunk.mlp.len()
    }

    /// The noise schedule that it was made for.
    pub fn schedule(&self) -> &Schedule {
        &self.schedule
    }

    fn split<'a>(&self, parameters: &'a [f32]) -> (&'a [f32], &'a [f32]) {
        parameters.split_at(self.time.len())
    }

    /// Embeds every t = 1..T.
    fn embed(&self, parameters: &[f32]) -> TimeEmbedding {
        let (time, trunk) = self.split(parameters);
        let ((inputs, width), (_, outputs)) = (self.time.shape(0), self.time.shape(1));
        let steps = self.schedule.steps();
        let affine = |x: &[f32], kernel: &[f32], bias: &[f32], k| {
            let mut out = vec![0.0; steps * bias.len()];
            product(x, kernel, &mut out, k, bias.len());
            out.chunks_exact_mut(bias.len()).for_each(|row| row.iter_mut().zip(bias).for_each(|(x, b)| *x += b));
            out
        };
        let before = affine(&self.features, self.time.kernel(time, 0), self.time.bias(time, 0), inputs);
        let (mut hidden, mut slope) = (vec![0.0; before.len()], vec![0.0; before.len()]);
        mish_slope(&before, &mut hidden, &mut slope);
        let embedding = affine(&hidden, self.time.kernel(time, 1), self.time.bias(time, 1), width);
        let shift = affine(&embedding, self.trunk.tail_kernel(trunk), self.trunk.mlp.bias(trunk, 0), outputs);
        TimeEmbedding { hidden, slope, embedding, shift }
    }

    /// Prepares parameters for [`Self::sample`].
    pub fn round(&self, parameters: &[f32], precision: Precision) -> RoundedActor {
        let (_, trunk) = self.split(parameters);
        RoundedActor(if precision == Precision::Bf16 { self.trunk.round(trunk) } else { None })
    }

    /// Draws actions by the whole reverse process (DDPM), x_0 clipped to [-1, 1] at each step.
    ///
    /// `rounded` is of the same parameters, `noise` is `T × rows × action_dim`, standard normal, rows being states ×
    /// `repeat`: first a^T, then the noise of the reverse steps from t = T down to 2. `actions` is `rows × action_dim`.
    pub fn sample(
        &self,
        parameters: &[f32],
        rounded: &RoundedActor,
        observations: &[f32],
        repeat: usize,
        noise: &[f32],
        actions: &mut [f32],
    ) {
        let a = self.trunk.action_dim;
        let (_, trunk) = self.split(parameters);
        let (embedding, all, steps) = (self.embed(parameters), actions.len(), self.schedule.steps());
        // A small batch is cut finer, so that every thread gets a share.
        let share = (all / a).div_ceil(rayon::current_num_threads()).clamp(1, TILE);
        let states = (share / repeat).max(1);
        let tile = states * repeat * a;
        actions.par_chunks_mut(tile).enumerate().for_each(|(i, actions)| {
            let observations = part(observations, i * states, states, self.trunk.observation_dim);
            with_workspace(|work| {
                let (mut base, mut out) = (std::mem::take(&mut work.base), std::mem::take(&mut work.out));
                let len = observations.len() / self.trunk.observation_dim * self.trunk.hidden;
                self.trunk.state_part(trunk, observations, base.sized(len));
                actions.copy_from_slice(&noise[i * tile..][..actions.len()]);
                for t in (1..=steps).rev() {
                    let shift = &embedding.shift[(t - 1) * self.trunk.hidden..][..self.trunk.hidden];
                    let input = Input { base: base.first(len), repeat, shift, actions };
                    let epsilon = out.sized(actions.len());
                    self.trunk.forward(trunk, rounded.0.as_ref(), input, work, epsilon);
                    let z = if t > 1 { &noise[(steps - t + 1) * all + i * tile..][..actions.len()] } else { &[] };
                    self.schedule.reverse(t, actions, epsilon, z);
                }
                (work.base, work.out) = (base, out);
            });
        });
    }

    /// Runs one tile with its own t per row: the state part takes each row's time part along.
    fn tile(
        &self,
        trunk: &[f32],
        embedding: &TimeEmbedding,
        input: NoisyActions<'_>,
        work: &mut Workspace,
        run: impl FnOnce(Input<'_>, &mut Workspace),
    ) {
        let (h, mut base) = (self.trunk.hidden, std::mem::take(&mut work.base));
        let rows = base.sized(input.t.len() * h);
        self.trunk.state_part(trunk, input.observations, rows);
        for (row, t) in rows.chunks_exact_mut(h).zip(input.t) {
            let shift = &embedding.shift[(t - 1) * h..][..h];
            row.iter_mut().zip(shift).for_each(|(x, s)| *x += s);
        }
        let zero = vec![0.0; h];
        run(Input { base: rows, repeat: 1, shift: &zero, actions: input.actions }, work);
        work.base = base;
    }

    fn tile_of<'a>(&self, input: NoisyActions<'a>, i: usize) -> NoisyActions<'a> {
        let from = i * TILE;
        NoisyActions {
            observations: part(input.observations, from, TILE, self.trunk.observation_dim),
            actions: part(input.actions, from, TILE, self.trunk.action_dim),
            t: &input.t[from..(from + TILE).min(input.t.len())],
        }
    }

    /// `out[batch × action_dim] = ε_θ(a^t, s, t)`.
    pub fn predict(&self, parameters: &[f32], input: NoisyActions<'_>, out: &mut [f32]) {
        let (_, trunk) = self.split(parameters);
        let embedding = self.embed(parameters);
        out.par_chunks_mut(TILE * self.trunk.action_dim).enumerate().for_each(|(i, out)| {
            with_workspace(|work| {
                self.tile(trunk, &embedding, self.tile_of(input, i), work, |tile, work| {
                    self.trunk.forward(trunk, None, tile, work, out);
                });
            });
        });
    }

    /// [`Self::predict`] that can be gone back through.
    pub fn record(&self, parameters: &[f32], input: NoisyActions<'_>, out: &mut [f32]) -> Recording {
        let (_, trunk) = self.split(parameters);
        let embedding = self.embed(parameters);
        let forward = |(i, out)| {
            let mut work = Workspace::default();
            self.tile(trunk, &embedding, self.tile_of(input, i), &mut work, |tile, work| {
                self.trunk.forward_recorded(trunk, tile, work, out);
            });
            work
        };
        let tiles = out.par_chunks_mut(TILE * self.trunk.action_dim).enumerate().map(forward).collect();
        Recording { embedding, tiles }
    }

    /// The gradient of a loss through ε_θ: from ∂L/∂ε, `batch × action_dim`, to that of the parameters. `recording` is
    /// of the same parameters and input.
    pub fn differentiate(
        &self,
        parameters: &[f32],
        input: NoisyActions<'_>,
        recording: Recording,
        output_gradient: &[f32],
        gradient: &mut [f32],
    ) {
        let (_, trunk) = self.split(parameters);
        let Recording { embedding, tiles } = recording;
        let (h, a, steps) = (self.trunk.hidden, self.trunk.action_dim, self.schedule.steps());
        // Per tile: the trunk's gradient, and δ of the first layer summed by t.
        let backward = |(i, mut work): (usize, Workspace)| {
            let (input, out) = (self.tile_of(input, i), part(output_gradient, i * TILE, TILE, a));
            let (mut trunk_gradient, mut by_step) = (vec![0.0; self.trunk.mlp.len()], vec![0.0; steps * h]);
            self.trunk.backward(trunk, out, &mut work);
            let mut inputs = Vec::new();
            concatenate(input.observations, input.actions, (self.trunk.observation_dim, a), &mut inputs);
            self.trunk.parameter_gradient(&inputs, out, &mut work, &mut trunk_gradient);
            for (t, delta) in input.t.iter().zip(work.slope[0].first(input.t.len() * h).chunks_exact(h)) {
                by_step[(t - 1) * h..][..h].iter_mut().zip(delta).for_each(|(sum, d)| *sum += d);
            }
            (trunk_gradient, by_step)
        };
        let results: Vec<(Vec<f32>, Vec<f32>)> = tiles.into_par_iter().enumerate().map(backward).collect();
        let mut by_step = vec![0.0; steps * h];
        let (time_gradient, trunk_gradient) = gradient.split_at_mut(self.time.len());
        trunk_gradient.fill(0.0);
        for (trunk, steps) in &results {
            trunk_gradient.iter_mut().zip(trunk).for_each(|(sum, g)| *sum += g);
            by_step.iter_mut().zip(steps).for_each(|(sum, g)| *sum += g);
        }
        self.differentiate_time(parameters, &embedding, &by_step, time_gradient, trunk_gradient);
    }

    /// The way back into the time embedding, once per t rather than once per row.
    fn differentiate_time(
        &self,
        parameters: &[f32],
        embedding: &TimeEmbedding,
        by_step: &[f32],
        time_gradient: &mut [f32],
        trunk_gradient: &mut [f32],
    ) {
        let (time, trunk) = self.split(parameters);
        let ((inputs, width), (_, outputs)) = (self.time.shape(0), self.time.shape(1));
        let (h, steps) = (self.trunk.hidden, self.schedule.steps());
        let (kernel, _) = self.trunk.mlp.layer_mut(trunk_gradient, 0);
        let tail = kernel.len() - outputs * h;
        outer(&embedding.embedding, by_step, &mut kernel[tail..], outputs, h);
        let mut d_embedding = vec![0.0; steps * outputs];
        product_transposed(by_step, self.trunk.tail_kernel(trunk), &mut d_embedding, outputs, h);
        let (kernel, bias) = self.time.layer_mut(time_gradient, 1);
        outer(&embedding.hidden, &d_embedding, kernel, width, outputs);
        column_sums(&d_embedding, bias);
        let mut d_hidden = vec![0.0; steps * width];
        product_transposed(&d_embedding, self.time.kernel(time, 1), &mut d_hidden, width, outputs);
        multiply(&mut d_hidden, &embedding.slope);
        let (kernel, bias) = self.time.layer_mut(time_gradient, 0);
        outer(&self.features, &d_hidden, kernel, inputs, width);
        column_sums(&d_hidden, bias);
    }

    /// Layers of the time embedding and of the trunk.
    pub(crate) fn layers(&self) -> (&Mlp, &Mlp) {
        (&self.time, &self.trunk.mlp)
    }
}
