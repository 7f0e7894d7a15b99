//! One layer f(x·W + b) + c of a network whose layers do not follow one another in a row, differentiable in x, W, b and c.
//!
//! On the CPU a custom operation of candle's works on tiles of rows in parallel, and leaves the gradients of W and b where
//! [`Weights`] keep them. Elsewhere plain operations do.

use crate::kept_gradient::KeptGradient;
use crate::layers::TILE;
use crate::mlp_config::Initial;
use crate::network::rows_of;
use crate::plain;
use crate::slices::{has_fast_implementation, on_cpu, slice};
use crate::weights::{Part, Weights};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use quad_kernels::activation::{Activation, activate, activate_with_slope, column_sums, multiply};
use quad_kernels::product::{outer, product, product_transposed};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

/// Parts into which rows are cut for the gradient of W, whatever the number of threads.
const PARTS: usize = 8;

/// Where a layer lies in a vector of weights: its kernel `[in, out]`, then its bias `[out]`.
#[derive(Clone, Debug)]
pub(crate) struct Dense {
    start: usize,
    inputs: usize,
    pub outputs: usize,
    /// f; none is the identity.
    activation: Option<Activation>,
}

impl Dense {
    pub fn new(start: usize, inputs: usize, outputs: usize, activation: Option<Activation>) -> Self {
        Self { start, inputs, outputs, activation }
    }

    /// Where in the vector it lies.
    pub fn range(&self) -> Range<usize> {
        self.start..self.start + (self.inputs + 1) * self.outputs
    }

    /// Its tensors `{name}.kernel` and `{name}.bias`.
    pub fn parts(&self, name: &str, initial: Initial) -> [Part; 2] {
        let (kernel, bias) = initial.of_layer(self.inputs, self.outputs);
        let part = |kind: &str, shape: &[usize], start| {
            let name = format!("{name}.{kind}");
            Part { name, shape: shape.to_vec(), start }
        };
        [part("kernel", &[self.inputs, self.outputs], kernel), part("bias", &[self.outputs], bias)]
    }

    /// f(x·W + b), `[rows, out]`, of `x [rows, in]`; plus `added` c, `[n, out]`, where equally many consecutive rows share a
    /// row of c.
    pub fn forward(&self, weights: &Weights, x: &Tensor, added: Option<&Tensor>) -> Result<Tensor> {
        let (rows, width) = x.dims2()?;
        let of_added = added.map(|added| added.dims2()).transpose()?.unwrap_or((rows, self.outputs));
        let fits = of_added.0 > 0 && rows > 0 && rows.is_multiple_of(of_added.0) && of_added.1 == self.outputs;
        if width != self.inputs || !fits {
            bail!("a layer of {} and {} numbers got {rows} × {width} and {of_added:?}", self.inputs, self.outputs);
        }
        let values = weights.values();
        if !has_fast_implementation(values.device()) {
            return self.plain(values, x, added);
        }
        let kept = if values.track_op() { weights.kept_gradient().cloned() } else { None };
        let differentiable = values.track_op() || x.track_op() || added.is_some_and(Tensor::track_op);
        let added = match added {
            Some(added) => added.contiguous()?,
            None => Tensor::zeros((0, self.outputs), x.dtype(), x.device())?,
        };
        let slope = differentiable.then(Mutex::default);
        let gradient_of_x = x.track_op();
        values.apply_op3(&x.contiguous()?, &added, Operation { layer: self.clone(), kept, slope, gradient_of_x })
    }

    fn plain(&self, values: &Tensor, x: &Tensor, added: Option<&Tensor>) -> Result<Tensor> {
        let numbers = self.inputs * self.outputs;
        let kernel = values.narrow(0, self.start, numbers)?.reshape((self.inputs, self.outputs))?;
        let bias = values.narrow(0, self.start + numbers, self.outputs)?;
        let y = x.contiguous()?.matmul(&kernel)?.broadcast_add(&bias)?;
        let y = self.activation.map_or(Ok(y.clone()), |f| plain::activate(f, &y))?;
        match added {
            Some(added) => y + plain::repeat_rows(added, x.dim(0)? / added.dim(0)?)?,
            None => Ok(y),
        }
    }

    fn kernel<'a>(&self, weights: &'a [f32]) -> &'a [f32] {
        &weights[self.start..][..self.inputs * self.outputs]
    }

    fn bias<'a>(&self, weights: &'a [f32]) -> &'a [f32] {
        &weights[self.start + self.inputs * self.outputs..][..self.outputs]
    }

    /// The layer's output; writes the slopes of its activation to `slope`, which is as long or empty.
    fn run(&self, weights: &[f32], x: &[f32], added: &[f32], slope: &mut [f32]) -> Vec<f32> {
        let (inputs, n, bias) = (self.inputs, self.outputs, self.bias(weights));
        let rows = x.len() / inputs;
        let repeat = if added.is_empty() { 1 } else { rows * n / added.len() };
        let mut out = vec![0.0; rows * n];
        let slopes = slope.chunks_mut(TILE * n).map(Some).chain(std::iter::repeat_with(|| None));
        let tiles: Vec<_> = out.chunks_mut(TILE * n).zip(slopes).enumerate().collect();
        tiles.into_par_iter().for_each(|(i, (out, slope))| {
            product(rows_of(x, i * TILE, TILE, inputs), self.kernel(weights), out, inputs, n);
            match (self.activation, slope) {
                (Some(f), Some(slope)) => activate_with_slope(f, out, bias, slope),
                (Some(f), None) => activate(f, out, bias),
                (None, _) => out.chunks_exact_mut(n).for_each(|row| add(row, bias)),
            }
            if !added.is_empty() {
                let of_row = |row: usize| &added[(i * TILE + row) / repeat * n..][..n];
                out.chunks_exact_mut(n).enumerate().for_each(|(row, out)| add(out, of_row(row)));
            }
        });
        out
    }

    /// The gradients of kernel and bias, one behind the other, of the gradient δ before the activation.
    fn weight_gradient(&self, x: &[f32], delta: &[f32], out: &mut [f32]) {
        let (inputs, n) = (self.inputs, self.outputs);
        let part = (delta.len() / n).div_ceil(PARTS).max(TILE);
        let of_part = |(x, delta): (&[f32], &[f32])| {
            let mut gradient = vec![0.0; (inputs + 1) * n];
            let (kernel, bias) = gradient.split_at_mut(inputs * n);
            outer(x, delta, kernel, inputs, n);
            column_sums(delta, bias);
            gradient
        };
        let parts: Vec<_> = x.par_chunks(part * inputs).zip(delta.par_chunks(part * n)).map(of_part).collect();
        out.fill(0.0);
        parts.iter().for_each(|part| add(out, part));
    }
}

fn add(sum: &mut [f32], x: &[f32]) {
    sum.iter_mut().zip(x).for_each(|(sum, x)| *sum += x);
}

/// The custom operation of (weights, x, c); c may have no rows.
struct Operation {
    layer: Dense,
    /// Where the weights' gradient is left, if there is to be one.
    kept: Option<Arc<KeptGradient>>,
    /// Slopes of the activation, if there is to be a backward pass.
    slope: Option<Mutex<Vec<f32>>>,
    gradient_of_x: bool,
}

impl CustomOp3 for Operation {
    fn name(&self) -> &'static str {
        "dense"
    }

    fn cpu_fwd(
        &self,
        weights: &CpuStorage,
        weights_layout: &Layout,
        x: &CpuStorage,
        x_layout: &Layout,
        added: &CpuStorage,
        added_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (weights, x) = (slice(weights, weights_layout)?, slice(x, x_layout)?);
        let (rows, n) = (x_layout.dims()[0], self.layer.outputs);
        let kept = self.slope.is_some() && self.layer.activation.is_some();
        let mut slope = vec![0.0; if kept { rows * n } else { 0 }];
        let out = self.layer.run(weights, x, slice(added, added_layout)?, &mut slope);
        if let Some(left) = &self.slope {
            *left.lock().unwrap_or_else(PoisonError::into_inner) = slope;
        }
        Ok((CpuStorage::F32(out), (rows, n).into()))
    }

    fn bwd(
        &self,
        weights: &Tensor,
        x: &Tensor,
        added: &Tensor,
        _: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let Some(slope) = &self.slope else { return Ok((None, None, None)) };
        let (layer, (rows, n)) = (&self.layer, gradient.dims2()?);
        let (x, gradient) = (x.contiguous()?, gradient.contiguous()?);
        let of_added = match added.dim(0)? {
            0 => None,
            of if of == rows => Some(gradient.clone()),
            of => Some(gradient.reshape((of, rows / of, n))?.sum(1)?),
        };
        let held = [weights, &x, &gradient].map(Tensor::storage_and_layout);
        let [weights, input, gradient] = held.each_ref().map(|(storage, layout)| on_cpu::<f32>(storage, layout));
        let (weights, input) = (weights?, input?);
        let mut delta = gradient?.to_vec();
        let slope = slope.lock().unwrap_or_else(PoisonError::into_inner);
        let tiles = delta.par_chunks_mut(TILE * n).zip(slope.par_chunks(TILE * n));
        tiles.for_each(|(delta, slope)| multiply(delta, slope));
        if let Some(kept) = &self.kept {
            kept.write(layer.range(), |out| layer.weight_gradient(input, &delta, out))?;
        }
        if !self.gradient_of_x {
            return Ok((None, None, of_added));
        }
        let mut of_x = vec![0.0; rows * layer.inputs];
        of_x.par_chunks_mut(TILE * layer.inputs).zip(delta.par_chunks(TILE * n)).for_each(|(of_x, delta)| {
            product_transposed(delta, layer.kernel(weights), of_x, layer.inputs, n);
        });
        Ok((None, Some(Tensor::from_vec(of_x, x.shape(), x.device())?), of_added))
    }
}
