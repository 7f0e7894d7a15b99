//! Adam over the weights of a network: fast on the CPU, one kernel on a GPU, or in candle's
//! operations.

use crate::error::NetworkError;
use crate::gpu::cuda_graph::overwrite;
use crate::slices::{has_fast_implementation, modify, read};
use crate::weights::{Layout, Tensors, Weights};
use candle_core::{DType, Device, Result, Tensor};
use quad_kernels::optimizer::{AdamRates, BETA1, BETA2, EPSILON, adam, norm};

/// Adam (Kingma and Ba 2015), with β = (0.9, 0.999) and ε = 1e-8, for the weights of one network;
/// with a weight decay it is AdamW (Loshchilov and Hutter 2019).
pub struct Adam {
    /// First and second moments m and v, `[2, P]`.
    pub(crate) moments: Tensor,
    decay: f32,
    step: AdamStep,
    /// The step's [`AdamRates`] where a GPU reads them, `[3]`.
    rates: Tensor,
}

/// Hyper-parameters of one step.
#[derive(Clone, Copy, Debug)]
pub struct AdamStep {
    /// Learning rate.
    pub rate: f32,
    /// Largest norm of the gradient, which is scaled down to it.
    pub clip: Option<f32>,
    /// Number of the step, from 1.
    pub count: u64,
}

impl AdamStep {
    /// The step after `steps` others, without clipping.
    pub fn after(steps: u64, rate: f32) -> Self {
        let (clip, count) = (None, steps + 1);
        Self { rate, clip, count }
    }

    /// The step with its gradient scaled down to this norm.
    pub fn clipped(mut self, norm: f32) -> Self {
        self.clip = Some(norm);
        self
    }
}

impl Adam {
    /// Adam before its first step, with a weight decay λ or 0.
    pub fn new(weights: &Weights, decay: f32) -> Result<Self> {
        let values = weights.values();
        let zeros = |shape: &[usize]| Tensor::zeros(shape, DType::F32, values.device());
        let (moments, rates) = (zeros(&[2, values.elem_count()])?, zeros(&[3])?);
        let step = AdamStep::after(0, 0.0);
        Ok(Self { moments, decay, step, rates })
    }

    /// Sets the hyper-parameters of the steps that follow. A step captured in a CUDA graph reads
    /// them at each replay.
    pub fn set_step(&mut self, step: AdamStep) -> Result<()> {
        self.step = step;
        if self.rates.device().is_cuda() {
            let rates = AdamRates::new(step.rate, self.decay, step.count);
            let rates = [rates.rate, rates.decay, rates.correction];
            overwrite(&self.rates, &Tensor::new(&rates, &Device::Cpu)?)?;
        }
        Ok(())
    }

    /// The hyper-parameters last set.
    pub fn step(&self) -> AdamStep {
        self.step
    }

    /// Applies a gradient, `[P]`, to the weights. Returns its norm before clipping, `[]`.
    pub fn apply(&mut self, weights: &mut Weights, gradient: &Tensor) -> Result<Tensor> {
        #[cfg(feature = "cuda")]
        if gradient.device().is_cuda() {
            return self.gpu_step(weights, gradient);
        }
        match has_fast_implementation(gradient.device()) {
            true => self.fast_step(weights, gradient),
            false => self.plain_step(weights, gradient),
        }
    }

    fn fast_step(&mut self, weights: &mut Weights, gradient: &Tensor) -> Result<Tensor> {
        let AdamStep { rate, clip, count } = self.step;
        let len = gradient.elem_count();
        let size = read(gradient, norm)?;
        let scale = clip.map_or(1.0, |clip| (clip / size).min(1.0));
        let rates = AdamRates::new(rate, self.decay, count);
        read(gradient, |gradient: &[f32]| {
            modify(&self.moments, |moments| {
                let moments = moments.split_at_mut(len);
                weights.change(|weights| {
                    modify(weights, |weights| adam(weights, moments, gradient, scale, rates))
                })
            })
        })???;
        Tensor::new(size, gradient.device())
    }

    #[cfg(feature = "cuda")]
    fn gpu_step(&mut self, weights: &mut Weights, gradient: &Tensor) -> Result<Tensor> {
        use crate::gpu::tensors::{modify, read, tensor};
        let clip = self.step.clip.unwrap_or(f32::INFINITY);
        let mut size = None;
        let (gradient, moments) = (gradient.contiguous()?, &self.moments);
        read(&gradient, |gradient| {
            read(&self.rates, |rates| {
                modify(moments, |_, moments| {
                    weights.change(|weights| {
                        size = Some(modify(weights, |stream, weights| {
                            quad_kernels::cuda::adam(
                                stream, weights, moments, gradient, clip, rates,
                            )
                            .map_err(candle_core::Error::wrap)
                        })?);
                        Ok(())
                    })
                })
            })
        })?;
        let size = size.ok_or_else(|| candle_core::Error::Msg("Adam made no step".into()))?;
        tensor(size, (), &gradient)
    }

    fn plain_step(&mut self, weights: &mut Weights, gradient: &Tensor) -> Result<Tensor> {
        let AdamStep { rate, clip, count } = self.step;
        let size = gradient.sqr()?.sum_all()?.sqrt()?;
        let mut gradient = gradient.clone();
        if let Some(clip) = clip {
            let scale = (size.recip()? * f64::from(clip))?.minimum(1f32)?;
            gradient = gradient.broadcast_mul(&scale)?;
        }
        let first = ((self.moments.get(0)? * BETA1)? + (&gradient * (1.0 - BETA1))?)?;
        let second = ((self.moments.get(1)? * BETA2)? + (gradient.sqr()? * (1.0 - BETA2))?)?;
        let unbiased = (&first / (1.0 - BETA1.powf(count as f64)))?;
        let deviation = (&second / (1.0 - BETA2.powf(count as f64)))?.sqrt()?;
        let change = (unbiased / (deviation + f64::from(EPSILON))?)?;
        let change = match self.decay {
            0.0 => change,
            decay => (change + (weights.values().detach() * f64::from(decay))?)?,
        };
        let change = (change * f64::from(rate))?;
        self.moments = Tensor::stack(&[first, second], 0)?;
        weights.change(|weights| weights.slice_set(&(weights - change)?, 0, 0))?;
        Ok(size)
    }

    /// The moments by the names of their weights, after `adam_m.{name}` and `adam_v.{name}`.
    pub fn tensors(&self, layout: &Layout, name: &str) -> Result<Tensors> {
        let mut tensors = layout.split(&self.moments.get(0)?, &format!("adam_m.{name}"))?;
        tensors.extend(layout.split(&self.moments.get(1)?, &format!("adam_v.{name}"))?);
        Ok(tensors)
    }

    /// Restores moments saved by [`Self::tensors`], removing them from `tensors`.
    pub fn load(
        &mut self,
        layout: &Layout,
        tensors: &mut Tensors,
        name: &str,
    ) -> std::result::Result<(), NetworkError> {
        let first = layout.join(tensors, &format!("adam_m.{name}"))?;
        let second = layout.join(tensors, &format!("adam_v.{name}"))?;
        self.moments = Tensor::stack(&[first, second], 0)?.to_device(self.moments.device())?;
        Ok(())
    }
}

/// Learning rate schedule: a factor that falls from 1 at step 0 to 0 at `total` along a cosine.
pub fn cosine_decay(step: u64, total: u64) -> f32 {
    let progress = (step as f64 / total.max(1) as f64).min(1.0);
    (0.5 * (1.0 + (std::f64::consts::PI * progress).cos())) as f32
}
