//! One layer f(x·W + b) + c of a network whose layers do not follow one another in a row.

use crate::layers::config::Initial;
use crate::layers::flat::TILE;
use crate::layers::network::rows_of;
use crate::layers::plain;
use crate::slices::{has_fast_implementation, slice};
use crate::weights::TensorSpec;
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use quad_kernels::activation::{Activation, activate, activate_with_slope};
use quad_kernels::product::product;
use rayon::prelude::*;
use std::ops::Range;

/// Where a layer lies in a vector of weights: its kernel `[in, out]`, then its bias `[out]`.
#[derive(Clone, Debug)]
pub(crate) struct Dense {
    start: usize,
    pub inputs: usize,
    pub outputs: usize,
    /// f; none is the identity.
    activation: Option<Activation>,
}

impl Dense {
    pub fn new(
        start: usize,
        inputs: usize,
        outputs: usize,
        activation: Option<Activation>,
    ) -> Self {
        Self { start, inputs, outputs, activation }
    }

    /// Where in the vector it lies.
    pub fn range(&self) -> Range<usize> {
        self.start..self.start + (self.inputs + 1) * self.outputs
    }

    /// Its tensors `{name}.kernel` and `{name}.bias`.
    pub fn parts(&self, name: &str, initial: Initial) -> [TensorSpec; 2] {
        let (kernel, bias) = initial.of_layer(self.inputs, self.outputs, false);
        let part = |kind: &str, shape: &[usize], start| {
            let name = format!("{name}.{kind}");
            TensorSpec { name, shape: shape.to_vec(), start }
        };
        [part("kernel", &[self.inputs, self.outputs], kernel), part("bias", &[self.outputs], bias)]
    }

    /// Whether an activation follows.
    pub fn is_active(&self) -> bool {
        self.activation.is_some()
    }

    /// f(x·W + b), `[rows, out]`, of `x [rows, in]`; plus `added` c, `[n, out]`, where equally many
    /// consecutive rows share a row of c. Where plain operations do it, it is differentiable in all
    /// of them; else in none.
    pub fn forward(&self, weights: &Tensor, x: &Tensor, added: Option<&Tensor>) -> Result<Tensor> {
        let (rows, width) = x.dims2()?;
        let of_added =
            added.map(|added| added.dims2()).transpose()?.unwrap_or((rows, self.outputs));
        let fits = of_added.0 > 0
            && rows > 0
            && rows.is_multiple_of(of_added.0)
            && of_added.1 == self.outputs;
        if width != self.inputs || !fits {
            bail!(
                "a layer of {} and {} numbers got {rows} × {width} and {of_added:?}",
                self.inputs,
                self.outputs
            );
        }
        if !has_fast_implementation(weights.device()) {
            return self.plain(weights, x, added);
        }
        let added = match added {
            Some(added) => added.contiguous()?,
            None => Tensor::zeros((0, self.outputs), x.dtype(), x.device())?,
        };
        weights.detach().apply_op3_no_bwd(&x.contiguous()?, &added, &Operation(self.clone()))
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

    /// Its kernel in a vector of weights.
    pub fn kernel<'a>(&self, weights: &'a [f32]) -> &'a [f32] {
        &weights[self.start..][..self.inputs * self.outputs]
    }

    /// f(x·W + b) of some rows, and, if it has an activation, f' if that is wanted.
    pub fn apply(&self, weights: &[f32], x: &[f32], out: &mut [f32], slope: Option<&mut [f32]>) {
        let (kernel, n) = (self.kernel(weights), self.outputs);
        let bias = &weights[self.start + kernel.len()..][..n];
        product(x, kernel, out, self.inputs, n);
        match (self.activation, slope) {
            (Some(f), Some(slope)) => activate_with_slope(f, out, bias, slope),
            (Some(f), None) => activate(f, out, bias),
            (None, _) => out.chunks_exact_mut(n).for_each(|row| add(row, bias)),
        }
    }
}

/// Adds number by number.
pub(crate) fn add(sum: &mut [f32], x: &[f32]) {
    sum.iter_mut().zip(x).for_each(|(sum, x)| *sum += x);
}

/// The custom operation of (weights, x, c); c may have no rows.
struct Operation(Dense);

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
        let (weights, x, added) =
            (slice(weights, weights_layout)?, slice(x, x_layout)?, slice(added, added_layout)?);
        let (rows, n) = (x_layout.dims()[0], self.0.outputs);
        let repeat = if added.is_empty() { 1 } else { rows * n / added.len() };
        let mut out = vec![0.0; rows * n];
        out.par_chunks_mut(TILE * n).enumerate().for_each(|(i, out)| {
            self.0.apply(weights, rows_of(x, i * TILE, TILE, self.0.inputs), out, None);
            if !added.is_empty() {
                let of_row = |row: usize| &added[(i * TILE + row) / repeat * n..][..n];
                out.chunks_exact_mut(n).enumerate().for_each(|(row, out)| add(out, of_row(row)));
            }
        });
        Ok((CpuStorage::F32(out), (rows, n).into()))
    }
}
