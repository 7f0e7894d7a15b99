//! One layer f(x·W + b) + c of a [`DenseGraph`](crate::score::dense_graph::DenseGraph).

use crate::layers::config::InitScheme;
use crate::layers::flat::TILE;
use crate::layers::network::row_slice;
use crate::layers::plain;
use crate::slices::{has_fast_implementation, read_all};
use crate::weights::TensorSpec;
use candle_core::{Result, Tensor, bail};
use quad_kernels::Precision;
use quad_kernels::activation::{Activation, activate, activate_with_slope};
use quad_kernels::product::product;
use rayon::prelude::*;
use std::ops::Range;

/// A layer in a vector of weights: its kernel `[in, out]`, then its bias `[out]`.
#[derive(Clone, Debug)]
pub(crate) struct Dense {
    pub start: usize,
    pub inputs: usize,
    pub outputs: usize,
    /// f; `None` is the identity.
    pub activation: Option<Activation>,
    /// Arithmetic of the products with the kernel.
    pub precision: Precision,
}

impl Dense {
    /// Range in the vector.
    pub fn range(&self) -> Range<usize> {
        self.start..self.start + (self.inputs + 1) * self.outputs
    }

    /// The tensors `{name}.kernel` and `{name}.bias`.
    pub fn specs(&self, name: &str, initial: InitScheme) -> [TensorSpec; 2] {
        let (k, n) = (self.inputs, self.outputs);
        let (kernel, bias) = initial.layer(k, n, false);
        [
            TensorSpec::new(format!("{name}.kernel"), &[k, n], kernel),
            TensorSpec::new(format!("{name}.bias"), &[n], bias),
        ]
    }

    pub fn is_active(&self) -> bool {
        self.activation.is_some()
    }

    /// f(x·W + b) + c, `[rows, out]`, for `x [rows, in]` and `added` c, `[n, out]`, whose first row
    /// is added to the first rows/n rows, and so on. Differentiable in plain operations only.
    pub fn forward(&self, weights: &Tensor, x: &Tensor, added: Option<&Tensor>) -> Result<Tensor> {
        let ((rows, width), n) = (x.dims2()?, self.outputs);
        let (added_rows, added_width) = added.map_or(Ok((rows, n)), Tensor::dims2)?;
        let fits = added_rows > 0 && rows > 0 && rows.is_multiple_of(added_rows);
        if width != self.inputs || added_width != n || !fits {
            let sizes = (self.inputs, n);
            bail!(
                "a layer of {sizes:?} numbers got {rows} × {width} and {added_rows} × {added_width}"
            );
        }
        if !has_fast_implementation(weights.device()) {
            return self.plain(weights, x, added);
        }
        let added = match added {
            Some(added) => added.contiguous()?,
            None => Tensor::zeros((0, n), x.dtype(), x.device())?,
        };
        let repeat = rows / added_rows;
        let out = read_all([weights, &x.contiguous()?, &added], |[weights, x, added]| {
            let mut out = vec![0.0; rows * n];
            out.par_chunks_mut(TILE * n).enumerate().for_each(|(i, out)| {
                self.apply(weights, row_slice(x, i * TILE, TILE, self.inputs), out, None);
                if !added.is_empty() {
                    for (row, out) in out.chunks_exact_mut(n).enumerate() {
                        add(out, &added[(i * TILE + row) / repeat * n..][..n]);
                    }
                }
            });
            out
        })?;
        Tensor::from_vec(out, (rows, n), x.device())
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

    /// The kernel in a vector of weights.
    pub fn kernel<'a>(&self, weights: &'a [f32]) -> &'a [f32] {
        &weights[self.start..][..self.inputs * self.outputs]
    }

    /// f(x·W + b) of some rows, and with an activation its `slope` f'.
    pub fn apply(&self, weights: &[f32], x: &[f32], out: &mut [f32], slope: Option<&mut [f32]>) {
        let (kernel, n) = (self.kernel(weights), self.outputs);
        let bias = &weights[self.start + kernel.len()..][..n];
        product(self.precision, x, kernel, out, self.inputs, n);
        match (self.activation, slope) {
            (Some(f), Some(slope)) => activate_with_slope(f, out, bias, slope),
            (Some(f), None) => activate(f, out, bias),
            (None, _) => out.chunks_exact_mut(n).for_each(|row| add(row, bias)),
        }
    }
}

/// `sum = sum + x`.
pub(crate) fn add(sum: &mut [f32], x: &[f32]) {
    sum.iter_mut().zip(x).for_each(|(sum, x)| *sum += x);
}
