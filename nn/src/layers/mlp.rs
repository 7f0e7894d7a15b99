//! K networks of one shape side by side: layers act(x·W + b), differentiable in x, W and b.
//!
//! On the CPU one custom operation of candle's runs all layers, for tiles of one member's rows in
//! parallel. The tiles do not depend on the number of threads, so neither do the results. On a GPU a
//! kernel does (`gpu::dense`), or with a norm or wide layers `plain`.

use crate::gradients::buffer::GradientBuffer;
use crate::layers::flat::{Layers, TILE};
use crate::layers::network::{Network, row_slice};
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
            bail!("networks of {} numbers got {:?}", layers.inputs(), x.dims());
        }
        if !self.is_fast(weights) {
            return self.plain_forward(weights, &x);
        }
        let buffer = weights.gradient_buffer().filter(|_| values.track_op()).cloned();
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
        match x.rank() {
            2 => plain::mlp(&tensors, self.prefix, &self.layers, &x.unsqueeze(0)?),
            _ => plain::mlp(&tensors, self.prefix, &self.layers, x),
        }
    }

    pub fn network<'a>(&'a self, weights: &'a [f32], member: usize) -> Network<'a> {
        self.packed_network(weights, None, member)
    }

    /// A member with its packed kernels, if there are any.
    pub fn packed_network<'a>(
        &'a self,
        weights: &'a [f32],
        packed: Option<&'a Kernels>,
        member: usize,
    ) -> Network<'a> {
        let packed = packed.and_then(|packed| packed.get(member)).map(Vec::as_slice);
        let layers = &self.layers;
        Network { weights, layers, member, packed }
    }

    /// A forward pass without gradients: `x`, `rows × in` → `out`, `K × rows × out`.
    pub fn run(&self, weights: &[f32], packed: Option<&Kernels>, x: &[f32], out: &mut [f32]) {
        let (inputs, outputs) = (self.layers.inputs(), self.layers.outputs());
        let rows = out.len() / (self.layers.members * outputs);
        let members = out.par_chunks_mut(rows * outputs).enumerate();
        members.for_each(|(member, out)| {
            let network = self.packed_network(weights, packed, member);
            let tiles = out.par_chunks_mut(TILE * outputs).enumerate();
            tiles.for_each(|(i, out)| {
                let x = row_slice(x, i * TILE, TILE, inputs);
                let len = x.len() / inputs * network.width();
                with_workspace(|work| {
                    work.with_base(len, 0, |base, _, work| {
                        network.first_part(x, inputs, base);
                        let (repeat, shift, kernel, actions) = (1, network.bias(0), &[], &[]);
                        let first = FirstLayer { base, repeat, shift, actions, kernel };
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
        let (o, a) = (observations.len() / states, actions.len() / rows);
        let repeat = rows / states;
        let mut out = vec![0.0; self.layers.members * rows * a];
        let members = out.par_chunks_mut(rows * a).enumerate();
        members.for_each(|(member, out)| {
            let network = self.network(weights, member);
            let tiles = out.par_chunks_mut(TILE * a).enumerate();
            tiles.for_each(|(i, out)| {
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
            let x = row_slice(x, tile.index * TILE, TILE, layers.inputs());
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
        let mut copy = gradient.to_vec();
        saved.tiles(&mut copy).into_par_iter().for_each(|mut tile| {
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
        let gradients = members_gradients.par_chunks_mut(rows * width).enumerate();
        gradients.for_each(|(member, out)| {
            let (network, delta) = (self.mlp.network(weights, member), saved.first_delta(member));
            network.input_gradient(delta, (self.constant, width), out);
        });
        let mut sum = vec![0.0; rows * inputs];
        for member in members_gradients.chunks_exact(rows * width) {
            for (sum, x) in sum.chunks_exact_mut(inputs).zip(member.chunks_exact(width)) {
                let sum = sum[self.constant..].iter_mut();
                sum.zip(x).for_each(|(sum, x)| *sum += x);
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
