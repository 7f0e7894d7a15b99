//! Adam over the weights of a network, with an implementation for the CPU and one of plain candle
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
    /// Running means of the gradient and of its square, `[2, P]`.
    pub(crate) moments: Tensor,
    /// What each step takes off the weights, relative to them and to its rate.
    decay: f32,
    step: AdamStep,
    /// The numbers of [`AdamRates`], `[3]`, from where a GPU reads them.
    rates: Tensor,
}

/// One step's numbers.
#[derive(Clone, Copy, Debug)]
pub struct AdamStep {
    /// Step size, before the moments' bias corrections.
    pub rate: f32,
    /// Norm above which the gradient is scaled down to it.
    pub clip: Option<f32>,
    /// 1 for the first.
    pub count: u64,
}

impl AdamStep {
    /// The step after so many others, of gradients that are not clipped.
    pub fn after(steps: u64, rate: f32) -> Self {
        Self { rate, clip: None, count: steps + 1 }
    }
}

impl Adam {
    /// For weights that have not moved yet, with a weight decay, if it is not 0.
    pub fn new(weights: &Weights, decay: f32) -> Result<Self> {
        let values = weights.values();
        let zeros = |shape: &[usize]| Tensor::zeros(shape, DType::F32, values.device());
        let (moments, rates) = (zeros(&[2, values.elem_count()])?, zeros(&[3])?);
        Ok(Self { moments, decay, step: AdamStep { rate: 0.0, clip: None, count: 1 }, rates })
    }

    /// Moves the weights down a gradient. Gives its norm before clipping, `[]`.
    pub fn apply(
        &mut self,
        weights: &mut Weights,
        gradient: &Tensor,
        step: AdamStep,
    ) -> Result<Tensor> {
        self.set(step)?;
        self.apply_as_set(weights, gradient)
    }

    /// Sets the numbers of the next step, beforehand: they are not part of a recorded step.
    pub fn set(&mut self, step: AdamStep) -> Result<()> {
        self.step = step;
        if self.rates.device().is_cuda() {
            let AdamRates { rate, decay, correction } =
                AdamRates::new(step.rate, self.decay, step.count);
            overwrite(&self.rates, &Tensor::new(&[rate, decay, correction], &Device::Cpu)?)?;
        }
        Ok(())
    }

    /// What was set.
    pub fn step(&self) -> AdamStep {
        self.step
    }

    /// [`Self::apply`] with the numbers of [`Self::set`].
    pub fn apply_as_set(&mut self, weights: &mut Weights, gradient: &Tensor) -> Result<Tensor> {
        #[cfg(feature = "cuda")]
        if gradient.device().is_cuda() {
            return self.gpu_step(weights, gradient);
        }
        match has_fast_implementation(gradient.device()) {
            true => self.fused_step(weights, gradient, self.step),
            false => self.plain_step(weights, gradient, self.step),
        }
    }

    fn fused_step(
        &mut self,
        weights: &mut Weights,
        gradient: &Tensor,
        step: AdamStep,
    ) -> Result<Tensor> {
        let len = gradient.elem_count();
        let size = read(gradient, norm)?;
        let scale = step.clip.map_or(1.0, |clip| (clip / size).min(1.0));
        let rates = AdamRates::new(step.rate, self.decay, step.count);
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

    fn plain_step(
        &mut self,
        weights: &mut Weights,
        gradient: &Tensor,
        step: AdamStep,
    ) -> Result<Tensor> {
        let size = gradient.sqr()?.sum_all()?.sqrt()?;
        let gradient = match step.clip {
            Some(clip) => {
                gradient.broadcast_mul(&(size.recip()? * f64::from(clip))?.minimum(1f32)?)?
            }
            None => gradient.clone(),
        };
        let first = ((self.moments.get(0)? * BETA1)? + (&gradient * (1.0 - BETA1))?)?;
        let second = ((self.moments.get(1)? * BETA2)? + (gradient.sqr()? * (1.0 - BETA2))?)?;
        let unbiased = (&first / (1.0 - BETA1.powf(step.count as f64)))?;
        let deviation = (&second / (1.0 - BETA2.powf(step.count as f64)))?.sqrt()?;
        let change = (unbiased / (deviation + f64::from(EPSILON))?)?;
        let change = match self.decay {
            0.0 => change,
            decay => (change + (weights.values().detach() * f64::from(decay))?)?,
        };
        let change = (change * f64::from(step.rate))?;
        self.moments = Tensor::stack(&[first, second], 0)?;
        weights.change(|weights| weights.slice_set(&(weights - change)?, 0, 0))?;
        Ok(size)
    }

    /// The moments by name, like the weights of this layout that they are of: `adam_m.…` and
    /// `adam_v.…`.
    pub fn tensors(&self, layout: &Layout, name: &str) -> Result<Tensors> {
        let mut tensors = layout.split(&self.moments.get(0)?, &format!("adam_m.{name}"))?;
        tensors.extend(layout.split(&self.moments.get(1)?, &format!("adam_v.{name}"))?);
        Ok(tensors)
    }

    /// Takes over moments that [`Self::tensors`] gave.
    ///
    /// # Errors
    /// A moment that is missing or does not fit.
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

/// A factor that falls from 1 at step 0 to 0 at `total` along a cosine.
pub fn cosine_decay(step: u64, total: u64) -> f32 {
    let progress = (step as f64 / total.max(1) as f64).min(1.0);
    (0.5 * (1.0 + (std::f64::consts::PI * progress).cos())) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_learning_rate_falls_along_a_cosine() {
        assert_eq!(
            (cosine_decay(0, 100), cosine_decay(100, 100), cosine_decay(200, 100)),
            (1.0, 0.0, 0.0)
        );
        assert!((cosine_decay(50, 100) - 0.5).abs() < 1e-7);
    }
}
