//! Networks whose dense layers form a graph: outputs are added or concatenated.
//!
//! On the CPU the training of such a network is one custom operation of candle's. It takes chunks of
//! rows through all layers and back, in parallel; a step of SfBC takes 0.55 of the time with
//! candle's operations. Elsewhere, and for a network that only acts, each layer is one operation.

use crate::gradients::buffer::GradientBuffer;
use crate::layers::flat::TILE;
use crate::layers::network::row_slice;
use crate::layers::plain::repeat_rows;
use crate::pool::{Pool, Pooled};
use crate::score::dense::{Dense, add};
use crate::slices::{has_fast_implementation, read_all, slice};
use crate::weights::Weights;
use candle_core::{CpuStorage, CustomOp2, Error, Layout, Result, Shape, Tensor, bail};
use quad_kernels::activation::{column_sums, multiply};
use quad_kernels::product::{outer, product_transposed};
use rayon::prelude::*;
use std::sync::Arc;

/// Largest number of chunks of rows, which must not depend on the number of threads.
const CHUNKS: usize = 8;
/// Weights whose gradients are summed in one task.
const TOGETHER: usize = 1 << 14;

/// A step of the graph. Values are numbered: first the inputs, then one for each step.
pub(crate) enum Step {
    /// A layer of value `x`, plus value `added`.
    Dense {
        /// The layer, used in this step only.
        layer: Dense,
        x: usize,
        added: Option<usize>,
    },
    /// The concatenation of two values.
    Concat(usize, usize),
}

impl Step {
    /// The values that the step reads.
    fn values(&self) -> impl Iterator<Item = usize> + use<> {
        match *self {
            Self::Dense { x, added, .. } => [Some(x), added],
            Self::Concat(one, other) => [Some(one), Some(other)],
        }
        .into_iter()
        .flatten()
    }
}

/// A network; its output is the value of the last step.
pub(crate) struct DenseGraph {
    /// Number of inputs.
    inputs: usize,
    steps: Vec<Step>,
    /// The width of each value.
    widths: Vec<usize>,
    /// For each step, the values that no later step reads.
    done: Vec<Vec<usize>>,
    /// Number of weights.
    len: usize,
    pool: Arc<Pool<Vec<Chunk>>>,
}

/// Values, slopes and gradients of a chunk of rows.
#[derive(Default)]
struct Chunk {
    values: Vec<Vec<f32>>,
    /// Slopes of each step's activation; empty where it has none.
    slopes: Vec<Vec<f32>>,
    /// Gradient of each value; empty until one has reached it.
    gradients: Vec<Vec<f32>>,
    weights_gradient: Vec<f32>,
}

impl DenseGraph {
    /// A network of inputs of these widths with `len` weights.
    pub fn new(inputs: Vec<usize>, steps: Vec<Step>, len: usize) -> Self {
        let (count, mut widths) = (inputs.len(), inputs);
        for step in &steps {
            widths.push(match step {
                Step::Dense { layer, .. } => layer.outputs,
                Step::Concat(one, other) => widths[*one] + widths[*other],
            });
        }
        let is_last = |i: usize, number: &usize| {
            !steps[i + 1..].iter().any(|step| step.values().any(|n| n == *number))
        };
        let numbered = steps.iter().enumerate();
        let done = numbered.map(|(i, step)| step.values().filter(|n| is_last(i, n)).collect());
        let done = done.collect();
        Self { inputs: count, steps, widths, done, len, pool: Arc::default() }
    }

    /// The output `[rows, out]`, differentiable in the weights. The first rows/n rows belong to the
    /// first row of an input `[n, width]`, and so on.
    pub fn forward(self: &Arc<Self>, weights: &Weights, inputs: &[Tensor]) -> Result<Tensor> {
        let values = weights.values();
        let buffer = weights.gradient_buffer().filter(|_| has_fast_implementation(values.device()));
        if let Some(buffer) = buffer {
            let rows = inputs.iter().map(|x| x.dims()[0]).max().unwrap_or(0);
            let repeated = inputs.iter().map(|x| repeat_rows(x, rows / x.dims()[0]));
            let x = Tensor::cat(&repeated.collect::<Result<Vec<_>>>()?, 1)?.detach();
            let operation =
                Operation { graph: self.clone(), buffer: buffer.clone(), chunks: self.pool.lend() };
            return values.apply_op2(&x, operation);
        }
        let mut computed: Vec<Option<Tensor>> = inputs.iter().cloned().map(Some).collect();
        for (step, done) in self.steps.iter().zip(&self.done) {
            let value = |number: usize| {
                let missing = || Error::Msg("a value was dropped too early".into());
                computed[number].as_ref().ok_or_else(missing)
            };
            let next = match step {
                Step::Dense { layer, x, added } => {
                    layer.forward(values, value(*x)?, added.map(value).transpose()?)?
                }
                Step::Concat(one, other) => Tensor::cat(&[value(*one)?, value(*other)?], 1)?,
            };
            computed.push(Some(next));
            // Frees their memory.
            done.iter().for_each(|number| computed[*number] = None);
        }
        let output = computed.pop().flatten();
        output.map_or_else(|| bail!("a network without layers"), Ok)
    }

    /// The output of some rows of the concatenated inputs.
    fn forward_chunk(&self, weights: &[f32], x: &[f32], chunk: &mut Chunk, out: &mut [f32]) {
        let (values, slopes) = (&mut chunk.values, &mut chunk.slopes);
        values.resize_with(self.widths.len(), Vec::new);
        slopes.resize_with(self.steps.len(), Vec::new);
        let input_widths = &self.widths[..self.inputs];
        let inputs_width: usize = input_widths.iter().sum();
        let rows = x.len() / inputs_width;
        let mut from = 0;
        for (value, width) in values.iter_mut().zip(input_widths) {
            value.clear();
            x.chunks_exact(inputs_width)
                .for_each(|row| value.extend_from_slice(&row[from..from + width]));
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
                Step::Concat(one, other) => {
                    let left = before[*one].chunks_exact(self.widths[*one]);
                    let pairs = left.zip(before[*other].chunks_exact(self.widths[*other]));
                    for (out, (one, other)) in value.chunks_exact_mut(width).zip(pairs) {
                        out[..one.len()].copy_from_slice(one);
                        out[one.len()..].copy_from_slice(other);
                    }
                }
            }
        }
        out.copy_from_slice(&values[values.len() - 1]);
    }

    /// After [`Self::forward_chunk`]: the gradient of all weights, given the output's.
    fn backward_chunk(&self, weights: &[f32], gradient: &[f32], chunk: &mut Chunk) {
        let Chunk { values, slopes, gradients, weights_gradient } = chunk;
        gradients.resize_with(self.widths.len(), Vec::new);
        gradients.iter_mut().for_each(Vec::clear);
        weights_gradient.resize(self.len, 0.0);
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
                    let (precision, k, n) = (layer.precision, layer.inputs, layer.outputs);
                    let (kernel, bias) = weights_gradient[layer.range()].split_at_mut(k * n);
                    outer(precision, &values[*x], &delta, kernel, k, n);
                    column_sums(&delta, bias);
                    if *x >= self.inputs {
                        scratch.resize(values[*x].len(), 0.0);
                        let kernel = layer.kernel(weights);
                        product_transposed(precision, &delta, kernel, &mut scratch, k, n);
                        deposit(&mut gradients[*x], &scratch);
                    }
                }
                Step::Concat(one, other) => {
                    let (left, width) = (self.widths[*one], self.widths[self.inputs + i]);
                    for (number, columns) in [(one, 0..left), (other, left..width)] {
                        scratch.clear();
                        let rows = delta.chunks_exact(width);
                        rows.for_each(|row| scratch.extend_from_slice(&row[columns.clone()]));
                        deposit(&mut gradients[*number], &scratch);
                    }
                }
            }
            // Keeps its memory.
            delta.clear();
            gradients[self.inputs + i] = delta;
        }
    }
}

/// Adds to a gradient, or begins it.
fn deposit(gradient: &mut Vec<f32>, more: &[f32]) {
    match gradient.is_empty() {
        true => gradient.extend_from_slice(more),
        false => add(gradient, more),
    }
}

/// The operation of (weights, concatenated inputs).
struct Operation {
    graph: Arc<DenseGraph>,
    buffer: Arc<GradientBuffer>,
    chunks: Pooled<Vec<Chunk>>,
}

/// Rows of a chunk: a tile or more, so that there are at most [`CHUNKS`].
fn chunk_len(rows: usize) -> usize {
    rows.div_ceil(CHUNKS).max(TILE)
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
        let (rows, width) = x_layout.shape().dims2()?;
        let outputs = self.graph.widths[self.graph.widths.len() - 1];
        let len = chunk_len(rows);
        let mut out = vec![0.0; rows * outputs];
        let mut chunks = self.chunks.lock();
        chunks.resize_with(rows.div_ceil(len), Chunk::default);
        let tasks = chunks.par_iter_mut().zip(out.par_chunks_mut(len * outputs));
        tasks.enumerate().with_max_len(1).for_each(|(i, (chunk, out))| {
            let x = row_slice(x, i * len, len, width);
            self.graph.forward_chunk(weights, x, chunk, out);
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
        let (rows, outputs) = gradient.dims2()?;
        let mut chunks = self.chunks.lock();
        read_all([weights, &gradient.contiguous()?], |[weights, gradient]| {
            let gradients = gradient.par_chunks(chunk_len(rows) * outputs);
            let tasks = chunks.par_iter_mut().zip(gradients).with_max_len(1);
            tasks.for_each(|(chunk, gradient)| {
                self.graph.backward_chunk(weights, gradient, chunk);
            });
        })?;
        self.buffer.write(0..self.graph.len, |out| {
            out.par_chunks_mut(TOGETHER).enumerate().for_each(|(i, out)| {
                out.fill(0.0);
                for chunk in chunks.iter() {
                    let gradient = &chunk.weights_gradient[i * TOGETHER..];
                    add(out, &gradient[..out.len()]);
                }
            });
        })?;
        Ok((None, None))
    }
}
