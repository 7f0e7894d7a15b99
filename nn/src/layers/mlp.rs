//! K networks of one shape side by side: layers act(x·W + b), differentiable in x, W and b.
//!
//! On the CPU a custom operation of candle's runs all layers, cut into (member, tile of rows) and
//! in parallel; the cut does not depend on the number of threads, so neither do the results.
//! Elsewhere `composed` does, and with a norm plain operations do.

use crate::gradients::kept::KeptGradient;
use crate::layers::composed::{Composed, Pass};
use crate::layers::flat::{Layers, TILE};
use crate::layers::network::{Input, Network, rows_of};
use crate::layers::plain;
use crate::layers::saved::{Lent, Pool, SavedActivations};
use crate::layers::workspace::with_workspace;
use crate::slices::{has_fast_implementation, on_cpu, slice};
use crate::weights::Weights;
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};
use quad_kernels::product::Packed;
use rayon::prelude::*;
use std::sync::Arc;

/// For each network the kernels between its hidden layers, packed; none where products are as fast
/// without.
pub(crate) type Kernels = Vec<Vec<Packed>>;

/// Kernels of one member, if any were packed.
pub(crate) fn of_member(packed: Option<&Kernels>, member: usize) -> Option<&[Packed]> {
    packed.and_then(|packed| packed.get(member)).map(Vec::as_slice)
}

/// Networks over some part of a vector of weights.
#[derive(Clone)]
pub(crate) struct Mlp {
    pub layers: Arc<Layers>,
    /// Before the names of their tensors.
    prefix: &'static str,
    saved: Pool<SavedActivations>,
}

impl Mlp {
    pub fn new(layers: Layers, prefix: &'static str) -> Self {
        Self { layers: Arc::new(layers), prefix, saved: Pool::default() }
    }

    /// `inputs [rows, …]`, side by side → `[K, rows, out]`.
    pub fn forward(&self, weights: &Weights, inputs: &[&Tensor]) -> Result<Tensor> {
        self.forward_by(None, weights, inputs)
    }

    /// Applies the network; where no gradient is taken, by these packed kernels of the members.
    pub fn forward_by(
        &self,
        packed: Option<Arc<Kernels>>,
        weights: &Weights,
        inputs: &[&Tensor],
    ) -> Result<Tensor> {
        let x = if let [x] = inputs { (*x).clone() } else { Tensor::cat(inputs, 1)? };
        let (values, layers) = (weights.values(), &self.layers);
        if !matches!(*x.dims(), [rows, width] if rows > 0 && width == layers.inputs()) {
            bail!(
                "{} networks of {} numbers got inputs of shape {:?}",
                layers.members,
                layers.inputs(),
                x.dims()
            );
        }
        if !self.is_fast(weights) {
            return if layers.norm {
                self.plain_forward(weights, &x)
            } else {
                self.composed_forward(weights, &x)
            };
        }
        let kept = if values.track_op() { weights.kept_gradient().cloned() } else { None };
        let saved = (values.track_op() || x.track_op()).then(|| self.saved.lend());
        let constant = inputs
            .iter()
            .take_while(|input| !input.track_op())
            .map(|input| input.dim(1))
            .sum::<Result<_>>()?;
        values.apply_op2(
            &x.contiguous()?,
            Operation { mlp: self.clone(), kept, saved, packed, constant },
        )
    }

    /// Whether the fast implementation serves them.
    pub fn is_fast(&self, weights: &Weights) -> bool {
        has_fast_implementation(weights.values().device())
    }

    fn composed_forward(&self, weights: &Weights, x: &Tensor) -> Result<Tensor> {
        let differentiable = weights.values().track_op() || x.track_op();
        let pass = Pass::forward(&self.layers, weights, x, differentiable)?;
        if differentiable { weights.values().apply_op2(x, Composed(pass)) } else { Ok(pass.out) }
    }

    /// [`Self::forward`] in plain candle operations; here each member may have inputs of its own,
    /// `[K, rows, in]`.
    pub fn plain_forward(&self, weights: &Weights, x: &Tensor) -> Result<Tensor> {
        let tensors = weights.layout().split(weights.values(), "")?;
        let x = if x.rank() == 2 { x.unsqueeze(0)? } else { x.clone() };
        plain::mlp(&tensors, self.prefix, &self.layers, &x)
    }

    pub fn network<'a>(&'a self, weights: &'a [f32], member: usize) -> Network<'a> {
        Network { weights, layers: &self.layers, member, packed: None }
    }

    /// Forward of plain rows, nothing kept: `K × rows × out`.
    pub fn run(&self, weights: &[f32], packed: Option<&Kernels>, x: &[f32], out: &mut [f32]) {
        let (inputs, outputs) = (self.layers.inputs(), self.layers.outputs());
        let rows = out.len() / (self.layers.members * outputs);
        out.par_chunks_mut(rows * outputs).enumerate().for_each(|(member, out)| {
            let network =
                Network { packed: of_member(packed, member), ..self.network(weights, member) };
            out.par_chunks_mut(TILE * outputs).enumerate().for_each(|(i, out)| {
                let x = rows_of(x, i * TILE, TILE, inputs);
                with_workspace(|work| {
                    work.with_base(x.len() / inputs * network.width(), 0, |base, _, work| {
                        network.first_part(x, inputs, base);
                        let shift = network.bias(0);
                        network.forward(
                            Input { base, repeat: 1, shift, actions: &[], kernel: &[] },
                            work,
                            out,
                        );
                    });
                });
            });
        });
    }
}

/// The custom operation of (weights, inputs).
struct Operation {
    mlp: Mlp,
    /// Where the weights' gradient is left, if there is to be one.
    kept: Option<Arc<KeptGradient>>,
    /// What the forward pass keeps for the backward pass, if there is to be one.
    saved: Option<Lent<SavedActivations>>,
    /// What the products between hidden layers use, if nothing is kept.
    packed: Option<Arc<Kernels>>,
    /// How many of the inputs, the first ones, get no gradient.
    constant: usize,
}

impl Operation {
    fn forward_saving(
        &self,
        weights: &[f32],
        x: &[f32],
        lent: &Lent<SavedActivations>,
        out: &mut [f32],
    ) {
        let layers = &self.mlp.layers;
        let rows = out.len() / (layers.members * layers.outputs());
        let mut saved = lent.lock();
        saved.resize(layers, rows);
        saved.tiles(out).into_par_iter().for_each(|mut tile| {
            let x = rows_of(x, tile.index * TILE, TILE, layers.inputs());
            let network = self.mlp.network(weights, tile.member);
            with_workspace(|work| network.forward_saving(x, &mut tile.activations, work, tile.out));
        });
    }

    /// Leaves the weights' gradient where it is kept, and gives that of the inputs, if there is to
    /// be one.
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
        // The copy is cut up; the other is read as a whole.
        saved.tiles(&mut gradient.to_vec()).into_par_iter().for_each(|mut tile| {
            let network = self.mlp.network(weights, tile.member);
            with_workspace(|work| network.backward(tile.out, &mut tile.activations, work));
        });
        if let Some(kept) = &self.kept {
            kept.write(layers.range(), |out| {
                saved.weight_gradients(layers.split_mut(out), x, gradient)
            })?;
        }
        let width = inputs - self.constant;
        if width == 0 {
            return Ok(None);
        }
        let mut of_members = vec![0.0; members * rows * width];
        of_members.par_chunks_mut(rows * width).enumerate().for_each(|(member, out)| {
            let delta = saved.first_delta(member);
            self.mlp.network(weights, member).input_gradient(delta, (self.constant, width), out);
        });
        let mut sum = vec![0.0; rows * inputs];
        for member in of_members.chunks_exact(rows * width) {
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
            Some(saved) => self.forward_saving(weights, x, saved, &mut out),
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
        let of_input = {
            let held = [weights, &x, &gradient].map(Tensor::storage_and_layout);
            let [w, input, g] = held.each_ref().map(|(storage, layout)| on_cpu(storage, layout));
            self.backward(w?, input?, g?, &mut saved.lock())?
        };
        let of_input =
            of_input.map(|numbers| Tensor::from_vec(numbers, x.shape(), x.device())).transpose()?;
        Ok((None, of_input))
    }
}
