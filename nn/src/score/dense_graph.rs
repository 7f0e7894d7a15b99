//! Networks whose dense layers form a graph: outputs are added to others, or stand beside them.
//!
//! On the CPU a network that is trained is one custom operation of candle's. It works on parts of
//! the rows in parallel, each through all layers and back, and leaves the gradient where
//! [`Weights`] keep it. Elsewhere, and for a network that only acts, the layers are operations of
//! their own.

use crate::gradients::kept::KeptGradient;
use crate::layers::flat::TILE;
use crate::layers::network::rows_of;
use crate::layers::plain::repeat_rows;
use crate::layers::saved::{Lent, Pool};
use crate::score::dense::{Dense, add};
use crate::slices::{has_fast_implementation, on_cpu, slice};
use crate::weights::Weights;
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};
use quad_kernels::activation::{column_sums, multiply};
use quad_kernels::product::{outer, product_transposed};
use rayon::prelude::*;
use std::sync::Arc;

/// Parts into which rows are cut, whatever the number of threads.
const PARTS: usize = 8;
/// Weights whose gradient is added up at a time.
const TOGETHER: usize = 1 << 14;

/// How a value follows from those before it, which go by their numbers: the inputs' come first,
/// then one for each step.
pub(crate) enum Step {
    /// A layer of one value; plus another.
    Dense {
        /// The layer, of which no other step makes use.
        layer: Dense,
        /// What it is applied to.
        x: usize,
        /// What is added.
        added: Option<usize>,
    },
    /// Two values side by side.
    Beside(usize, usize),
}

impl Step {
    /// The values that it makes use of.
    fn values(&self) -> impl Iterator<Item = usize> + use<> {
        match *self {
            Self::Dense { x, added, .. } => [Some(x), added],
            Self::Beside(one, other) => [Some(one), Some(other)],
        }
        .into_iter()
        .flatten()
    }
}

/// A network; its output is what the last step makes.
pub(crate) struct DenseGraph {
    /// How many of the values are inputs.
    inputs: usize,
    steps: Vec<Step>,
    /// The width of each value.
    widths: Vec<usize>,
    /// The values that no step after this one makes use of, for each step.
    done: Vec<Vec<usize>>,
    /// Weights.
    len: usize,
    pool: Pool<Vec<Part>>,
}

/// What a part of the rows has made of each value, and what a backward pass makes of it.
#[derive(Default)]
struct Part {
    values: Vec<Vec<f32>>,
    /// The slopes of each step's activation; none where it has none.
    slopes: Vec<Vec<f32>>,
    /// The gradient of each value; empty where nothing has reached it.
    gradients: Vec<Vec<f32>>,
    of_weights: Vec<f32>,
}

impl DenseGraph {
    /// A network of inputs of these widths. Every layer's weights are in a vector of `len`, which
    /// they fill.
    pub fn new(inputs: Vec<usize>, steps: Vec<Step>, len: usize) -> Self {
        let (count, mut widths) = (inputs.len(), inputs);
        for step in &steps {
            widths.push(match step {
                Step::Dense { layer, .. } => layer.outputs,
                Step::Beside(one, other) => widths[*one] + widths[*other],
            });
        }
        let is_last = |i: usize, number: &usize| {
            !steps[i + 1..].iter().any(|step| step.values().any(|n| n == *number))
        };
        let done = steps
            .iter()
            .enumerate()
            .map(|(i, step)| step.values().filter(|n| is_last(i, n)).collect())
            .collect();
        Self { inputs: count, steps, widths, done, len, pool: Pool::default() }
    }

    /// The output of these inputs, `[n, width]` each; of one with fewer rows equally many
    /// consecutive rows of the others share one. Differentiable in the weights.
    pub fn forward(self: &Arc<Self>, weights: &Weights, inputs: &[Tensor]) -> Result<Tensor> {
        let values = weights.values();
        if let Some(kept) = weights
            .kept_gradient()
            .filter(|_| values.track_op() && has_fast_implementation(values.device()))
        {
            let rows = inputs
                .iter()
                .map(|x| x.dim(0))
                .collect::<Result<Vec<_>>>()?
                .into_iter()
                .max()
                .unwrap_or(0);
            let repeated = inputs
                .iter()
                .map(|x| repeat_rows(x, rows / x.dim(0)?))
                .collect::<Result<Vec<_>>>()?;
            let x = Tensor::cat(&repeated, 1)?.detach();
            let operation =
                Operation { graph: self.clone(), kept: kept.clone(), parts: self.pool.lend() };
            return values.apply_op2(&x, operation);
        }
        let mut known: Vec<Option<Tensor>> = inputs.iter().cloned().map(Some).collect();
        for (step, done) in self.steps.iter().zip(&self.done) {
            let value = |number: usize| {
                known[number]
                    .as_ref()
                    .ok_or_else(|| candle_core::Error::Msg("a value was dropped too early".into()))
            };
            let next = match step {
                Step::Dense { layer, x, added } => {
                    layer.forward(values, value(*x)?, added.map(value).transpose()?)?
                }
                Step::Beside(one, other) => Tensor::cat(&[value(*one)?, value(*other)?], 1)?,
            };
            known.push(Some(next));
            // They are large.
            done.iter().for_each(|number| known[*number] = None);
        }
        known.pop().flatten().map_or_else(|| candle_core::bail!("a network without layers"), Ok)
    }

    /// The output of some rows of the inputs side by side.
    fn forward_part(&self, weights: &[f32], x: &[f32], part: &mut Part, out: &mut [f32]) {
        let (values, slopes) = (&mut part.values, &mut part.slopes);
        values.resize_with(self.widths.len(), Vec::new);
        slopes.resize_with(self.steps.len(), Vec::new);
        let of_inputs = &self.widths[..self.inputs];
        let all: usize = of_inputs.iter().sum();
        let rows = x.len() / all;
        let mut from = 0;
        for (value, width) in values.iter_mut().zip(of_inputs) {
            value.clear();
            x.chunks_exact(all).for_each(|row| value.extend_from_slice(&row[from..from + width]));
            from += width;
        }
        for (i, step) in self.steps.iter().enumerate() {
            let (before, here) = values.split_at_mut(self.inputs + i);
            let (value, width) = (&mut here[0], self.widths[self.inputs + i]);
            value.resize(rows * width, 0.0);
            match step {
                Step::Dense { layer, x, added } => {
                    slopes[i].resize(if layer.is_active() { value.len() } else { 0 }, 0.0);
                    layer.apply(weights, &before[*x], value, Some(&mut slopes[i]));
                    added.iter().for_each(|added| add(value, &before[*added]));
                }
                Step::Beside(one, other) => {
                    let pairs = rows_in(&before[*one], self.widths[*one])
                        .zip(rows_in(&before[*other], self.widths[*other]));
                    for (out, (one, other)) in value.chunks_exact_mut(width).zip(pairs) {
                        out[..one.len()].copy_from_slice(one);
                        out[one.len()..].copy_from_slice(other);
                    }
                }
            }
        }
        out.copy_from_slice(&values[values.len() - 1]);
    }

    /// The gradient of all weights, of that of the output, after [`Self::forward_part`].
    fn backward_part(&self, weights: &[f32], gradient: &[f32], part: &mut Part) {
        let Part { values, slopes, gradients, of_weights } = part;
        gradients.resize_with(self.widths.len(), Vec::new);
        gradients.iter_mut().for_each(Vec::clear);
        of_weights.resize(self.len, 0.0);
        gradients[self.widths.len() - 1].extend_from_slice(gradient);
        let mut scratch = Vec::new();
        for (i, step) in self.steps.iter().enumerate().rev() {
            let mut delta = std::mem::take(&mut gradients[self.inputs + i]);
            match step {
                Step::Dense { layer, x, added } => {
                    added.iter().for_each(|added| deposit(&mut gradients[*added], &delta));
                    if layer.is_active() {
                        multiply(&mut delta, &slopes[i]);
                    }
                    let (kernel, bias) =
                        of_weights[layer.range()].split_at_mut(layer.inputs * layer.outputs);
                    outer(&values[*x], &delta, kernel, layer.inputs, layer.outputs);
                    column_sums(&delta, bias);
                    if *x >= self.inputs {
                        scratch.resize(values[*x].len(), 0.0);
                        product_transposed(
                            &delta,
                            layer.kernel(weights),
                            &mut scratch,
                            layer.inputs,
                            layer.outputs,
                        );
                        deposit(&mut gradients[*x], &scratch);
                    }
                }
                Step::Beside(one, other) => {
                    let (left, width) = (self.widths[*one], self.widths[self.inputs + i]);
                    for (number, columns) in [(one, 0..left), (other, left..width)] {
                        scratch.clear();
                        rows_in(&delta, width)
                            .for_each(|row| scratch.extend_from_slice(&row[columns.clone()]));
                        deposit(&mut gradients[*number], &scratch);
                    }
                }
            }
            // Its memory is used again.
            delta.clear();
            gradients[self.inputs + i] = delta;
        }
    }
}

fn rows_in(values: &[f32], width: usize) -> impl Iterator<Item = &[f32]> {
    values.chunks_exact(width)
}

/// Adds to a gradient, or begins it.
fn deposit(gradient: &mut Vec<f32>, more: &[f32]) {
    if gradient.is_empty() { gradient.extend_from_slice(more) } else { add(gradient, more) }
}

/// The network as an operation of (weights, its inputs side by side).
struct Operation {
    graph: Arc<DenseGraph>,
    kept: Arc<KeptGradient>,
    parts: Lent<Vec<Part>>,
}

fn rows_of_part(rows: usize) -> usize {
    rows.div_ceil(PARTS).max(TILE)
}

impl CustomOp2 for Operation {
    fn name(&self) -> &'static str {
        "dense-graph"
    }

    fn cpu_fwd(
        &self,
        weights: &CpuStorage,
        weights_layout: &Layout,
        x: &CpuStorage,
        x_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (weights, x) = (slice(weights, weights_layout)?, slice(x, x_layout)?);
        let ((rows, width), outputs) =
            (x_layout.shape().dims2()?, self.graph.widths[self.graph.widths.len() - 1]);
        let (mut out, of_part) = (vec![0.0; rows * outputs], rows_of_part(rows));
        let mut parts = self.parts.lock();
        parts.resize_with(rows.div_ceil(of_part), Part::default);
        let of_parts = parts.par_iter_mut().zip(out.par_chunks_mut(of_part * outputs)).enumerate();
        of_parts.with_max_len(1).for_each(|(i, (part, out))| {
            self.graph.forward_part(weights, rows_of(x, i * of_part, of_part, width), part, out);
        });
        Ok((CpuStorage::F32(out), (rows, outputs).into()))
    }

    fn bwd(
        &self,
        weights: &Tensor,
        _: &Tensor,
        _: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let ((rows, outputs), gradient) = (gradient.dims2()?, gradient.contiguous()?);
        let held = [weights, &gradient].map(Tensor::storage_and_layout);
        let [weights, gradient] =
            held.each_ref().map(|(storage, layout)| on_cpu::<f32>(storage, layout));
        let (weights, gradient) = (weights?, gradient?);
        let mut parts = self.parts.lock();
        let of_parts = parts.par_iter_mut().zip(gradient.par_chunks(rows_of_part(rows) * outputs));
        of_parts
            .with_max_len(1)
            .for_each(|(part, gradient)| self.graph.backward_part(weights, gradient, part));
        self.kept.write(0..self.graph.len, |out| {
            out.par_chunks_mut(TOGETHER).enumerate().for_each(|(i, out)| {
                out.fill(0.0);
                parts.iter().for_each(|part| {
                    add(out, rows_of(&part.of_weights, i * TOGETHER, TOGETHER, 1))
                });
            });
        })?;
        Ok((None, None))
    }
}
