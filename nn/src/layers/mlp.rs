//! K networks of one shape side by side: layers act(x·W + b), differentiable in x, W and b.
//!
//! On the CPU one custom operation of candle's runs all layers, for tiles of one member's rows in
//! parallel. The tiles do not depend on the number of threads, so neither do the results. On a GPU a
//! kernel does (`gpu::dense`), or with a norm or wide layers `plain`.

use crate::gradients::buffer::GradientBuffer;
use crate::layers::flat::{Layers, TILE};
use crate::layers::network::{Network, rows_of};
use crate::layers::plain;
use crate::layers::saved::SavedActivations;
use crate::layers::workspace::with_workspace;
use crate::pool::{Pool, Pooled};
use crate::slices::{has_fast_implementation, read_all, slice};
use crate::weights::Weights;
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};
use quad_kernels::narrow::FirstLayer;
use quad_kernels::product::Packed;
use rayon::prelude::*;
use std::sync::Arc;

/// Packed kernels between the hidden layers of each network; empty where packing gains nothing.
pub(crate) type Kernels = Vec<Vec<Packed>>;

/// Packed kernels of one member.
pub(crate) fn member_kernels(packed: Option<&Kernels>, member: usize) -> Option<&[Packed]> {
    packed.and_then(|packed| packed.get(member)).map(Vec::as_slice)
}

/// Networks in a range of a vector of weights.
#[derive(Clone)]
pub(crate) struct Mlp {
    pub layers: Arc<Layers>,
    /// Prefix of the tensors' names.
    prefix: &'static str,
    saved: Arc<Pool<SavedActivations>>,
}

impl Mlp {
    pub fn new(layers: Layers, prefix: &'static str) -> Self {
        let (layers, saved) = (Arc::new(layers), Arc::default());
        Self { layers, prefix, saved }
    }

    /// The outputs `[K, rows, out]` for inputs that [`plain::side_by_side`] concatenates.
    pub fn forward(&self, weights: &Weights, inputs: &[&Tensor]) -> Result<Tensor> {
        self.forward_by(None, weights, inputs)
    }

    /// [`Self::forward`] with packed kernels, which are used where no gradient is taken.
    pub fn forward_by(
        &self,
        packed: Option<Arc<Kernels>>,
        weights: &Weights,
        inputs: &[&Tensor],
    ) -> Result<Tensor> {
        #[cfg(feature = "cuda")]
        if let Some(dense) = crate::gpu::dense::dense(&self.layers, weights) {
            return crate::gpu::dense::forward(dense, weights, inputs);
        }
        let x = plain::side_by_side(inputs)?;
        let (values, layers) = (weights.values(), &self.layers);
        if !matches!(*x.dims(), [rows, width] if rows > 0 && width == layers.inputs()) {
            let (members, inputs) = (layers.members, layers.inputs());
            bail!("{members} networks of {inputs} numbers got inputs of shape {:?}", x.dims());
        }
        if !self.is_fast(weights) {
            return self.plain_forward(weights, &x);
        }
        let buffer = if values.track_op() { weights.gradient_buffer().cloned() } else { None };
        let saved = (values.track_op() || x.track_op()).then(|| self.saved.lend());
        let constant = inputs.iter().take_while(|input| !input.track_op());
        let constant = constant.map(|input| input.dim(1)).sum::<Result<_>>()?;
        let operation = Operation { mlp: self.clone(), buffer, saved, packed, constant };
        values.apply_op2(&x.contiguous()?, operation)
    }

    /// True if the fast implementation runs these weights.
    pub fn is_fast(&self, weights: &Weights) -> bool {
        has_fast_implementation(weights.values().device())
    }

    /// [`Self::forward`] in candle's operations, also for inputs of each member, `[K, rows, in]`.
    pub fn plain_forward(&self, weights: &Weights, x: &Tensor) -> Result<Tensor> {
        let tensors = weights.layout().split(weights.values(), "")?;
        let x = if x.rank() == 2 { x.unsqueeze(0)? } else { x.clone() };
        plain::mlp(&tensors, self.prefix, &self.layers, &x)
    }

    pub fn network<'a>(&'a self, weights: &'a [f32], member: usize) -> Network<'a> {
        Network { weights, layers: &self.layers, member, packed: None }
    }

    /// A forward pass without gradients: `x`, `rows × in` → `out`, `K × rows × out`.
    pub fn run(&self, weights: &[f32], packed: Option<&Kernels>, x: &[f32], out: &mut [f32]) {
        let (inputs, outputs) = (self.layers.inputs(), self.layers.outputs());
        let rows = out.len() / (self.layers.members * outputs);
        out.par_chunks_mut(rows * outputs).enumerate().for_each(|(member, out)| {
            let network =
                Network { packed: member_kernels(packed, member), ..self.network(weights, member) };
            out.par_chunks_mut(TILE * outputs).enumerate().for_each(|(i, out)| {
                let x = rows_of(x, i * TILE, TILE, inputs);
                with_workspace(|work| {
                    work.with_base(x.len() / inputs * network.width(), 0, |base, _, work| {
                        network.first_part(x, inputs, base);
                        let (shift, none) = (network.bias(0), &[]);
                        let first =
                            FirstLayer { base, repeat: 1, shift, actions: none, kernel: none };
                        network.forward(first, work, out);
                    });
                });
            });
        });
    }

    /// ∇_a Q of networks of [s, a] with one output, `K × rows × a`, for equally many rows of
    /// actions per state. Each tile of rows goes forward and back while its activations are in a
    /// core's cache.
    pub fn action_gradients(
        &self,
        weights: &[f32],
        (observations, states): (&[f32], usize),
        (actions, rows): (&[f32], usize),
    ) -> Vec<f32> {
        let (o, a, repeat) = (observations.len() / states, actions.len() / rows, rows / states);
        let mut out = vec![0.0; self.layers.members * rows * a];
        out.par_chunks_mut(rows * a).enumerate().for_each(|(member, out)| {
            let network = self.network(weights, member);
            out.par_chunks_mut(TILE * a).enumerate().for_each(|(i, out)| {
                let count = out.len() / a;
                let mut x = Vec::with_capacity(count * (o + a)); // [s, a]
                for row in i * TILE..i * TILE + count {
                    x.extend_from_slice(&observations[row / repeat * o..][..o]);
                    x.extend_from_slice(&actions[row * a..][..a]);
                }
                with_workspace(|work| {
                    work.with_activations(count, &self.layers, |saved, work| {
                        let mut values = vec![0.0; count];
                        network.forward_saving(&x, saved, work, &mut values);
                        values.fill(1.0);
                        network.backward(&values, saved, work);
                        network.input_gradient(saved.slope[0], (o, a), out);
                    });
                });
            });
        });
        out
    }
}

/// The custom operation of (weights, inputs).
struct Operation {
    mlp: Mlp,
    /// Memory for the weights' gradient, if it is taken.
    buffer: Option<Arc<GradientBuffer>>,
    /// Activations for the backward pass, if there is one.
    saved: Option<Pooled<SavedActivations>>,
    /// Kernels for a forward pass without gradients.
    packed: Option<Arc<Kernels>>,
    /// Number of leading inputs without gradient.
    constant: usize,
}

impl Operation {
    fn forward_saving(
        &self,
        weights: &[f32],
        x: &[f32],
        saved: &mut SavedActivations,
        out: &mut [f32],
    ) {
        let layers = &self.mlp.layers;
        saved.resize(layers, out.len() / (layers.members * layers.outputs()));
        saved.tiles(out).into_par_iter().for_each(|mut tile| {
            let x = rows_of(x, tile.index * TILE, TILE, layers.inputs());
            let network = self.mlp.network(weights, tile.member);
            with_workspace(|work| network.forward_saving(x, &mut tile.activations, work, tile.out));
        });
    }

    /// Writes the weights' gradient to the buffer and returns that of the inputs, if it is taken.
    fn backward(
        &self,
        weights: &[f32],
        x: &[f32],
        gradient: &[f32],
        saved: &mut SavedActivations,
    ) -> Result<Option<Vec<f32>>> {
        let layers = &self.mlp.layers;
        let (members, inputs) = (layers.members, layers.inputs());
        let rows = gradient.len() / (members * layers.outputs());
        // A copy, since tiles are mutable.
        saved.tiles(&mut gradient.to_vec()).into_par_iter().for_each(|mut tile| {
            let network = self.mlp.network(weights, tile.member);
            with_workspace(|work| network.backward(tile.out, &mut tile.activations, work));
        });
        if let Some(buffer) = &self.buffer {
            buffer.write(layers.range(), |out| {
                saved.weight_gradients(layers.split_mut(out), x, gradient)
            })?;
        }
        let width = inputs - self.constant;
        if width == 0 {
            return Ok(None);
        }
        let mut members_gradients = vec![0.0; members * rows * width];
        members_gradients.par_chunks_mut(rows * width).enumerate().for_each(|(member, out)| {
            let delta = saved.first_delta(member);
            self.mlp.network(weights, member).input_gradient(delta, (self.constant, width), out);
        });
        let mut sum = vec![0.0; rows * inputs];
        for member in members_gradients.chunks_exact(rows * width) {
            for (sum, x) in sum.chunks_exact_mut(inputs).zip(member.chunks_exact(width)) {
                sum[self.constant..].iter_mut().zip(x).for_each(|(sum, x)| *sum += x);
            }
        }
        Ok(Some(sum))
    }
}

impl CustomOp2 for Operation {
    fn name(&self) -> &'static str {
        "mlp"
    }

    fn cpu_fwd(
        &self,
        weights: &CpuStorage,
        weights_layout: &Layout,
        x: &CpuStorage,
        x_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (weights, x) = (slice(weights, weights_layout)?, slice(x, x_layout)?);
        let (members, outputs) = (self.mlp.layers.members, self.mlp.layers.outputs());
        let rows = x_layout.dims()[0];
        let mut out = vec![0.0; members * rows * outputs];
        match &self.saved {
            Some(saved) => self.forward_saving(weights, x, &mut saved.lock(), &mut out),
            None => self.mlp.run(weights, self.packed.as_deref(), x, &mut out),
        }
        Ok((CpuStorage::F32(out), (members, rows, outputs).into()))
    }

    fn bwd(
        &self,
        weights: &Tensor,
        x: &Tensor,
        _: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let Some(saved) = &self.saved else { return Ok((None, None)) };
        let (x, gradient) = (x.contiguous()?, gradient.contiguous()?);
        let inputs_gradient = read_all([weights, &x, &gradient], |[weights, x, gradient]| {
            self.backward(weights, x, gradient, &mut saved.lock())
        })??;
        let tensor = |numbers| Tensor::from_vec(numbers, x.shape(), x.device());
        Ok((None, inputs_gradient.map(tensor).transpose()?))
    }
}
