//! Noisy actions of a policy, and the critics' gradients there.

use candle_core::{D, DType, Device, Result, Tensor};
use quad_nn::{Ensemble, NoisePredictor, mean_and_variance};
use rand::Rng;
use rand_distr::StandardNormal;

/// Reverse processes per state. For each state and t the first of their actions that fits is taken.
const CHAINS: usize = 64;

/// Actions a^t of the reverse process, and gradients of the value there; numbers are `f64`.
pub struct Noisy {
    /// Index of the state, and t.
    pub of: Vec<(usize, usize)>,
    /// `[n, a]`.
    pub actions: Tensor,
    /// u of Eq. 21: unit vectors along the predicted noise, `[n, a]`.
    pub directions: Tensor,
    /// ∇_a Q_k(s, a^t) of each critic, `[n, K, a]`.
    pub gradients: Tensor,
    /// The critics' mean gradients at the denoised estimates, `[n, a]`.
    pub denoised: Tensor,
}

impl Noisy {
    /// Draws actions that stay within ±1 if changed by `margin`, for `observations`, `[n, o]`. Also
    /// returns the fraction of others for t = 1..T, and the mean of |Q_k(s, a)| over the policy's own
    /// actions, by which training divides gradients.
    pub fn draw(
        (actor, critics): (&NoisePredictor, &Ensemble),
        observations: &Tensor,
        margin: f32,
        random: &mut impl Rng,
    ) -> Result<(Self, Vec<f64>, f64)> {
        let (states, shape) = (observations.dim(0)?, actor.shape());
        let (rows, steps) = (states * CHAINS, shape.diffusion_steps);
        let noise = normal((steps, rows, shape.action_dim), random)?;
        let of_rows = (0..rows).map(|row| (row / CHAINS) as u32);
        let observations = observations.index_select(&indices(of_rows)?, 0)?;
        let (mut of, mut parts, mut outside) = (Vec::new(), Vec::<[Tensor; 4]>::new(), Vec::new());
        let mut noisy = noise.get(0)?; // a^T
        for t in (1..=steps).rev() {
            let actions: Vec<Vec<f32>> = noisy.to_vec2()?;
            let fits = |row: &usize| actions[*row].iter().all(|x| x.abs() <= 1.0 - margin);
            outside.push(1.0 - (0..rows).filter(fits).count() as f64 / rows as f64);
            let first = |state| (state * CHAINS..(state + 1) * CHAINS).find(fits);
            let kept = Vec::from_iter((0..states).filter_map(first));
            if !kept.is_empty() {
                of.extend(kept.iter().map(|row| (row / CHAINS, t)));
                let kept = indices(kept.iter().map(|row| *row as u32))?;
                let [s, a] = [observations.index_select(&kept, 0)?, noisy.index_select(&kept, 0)?];
                let gradients = critics.action_gradients(&s, &a)?.transpose(0, 1)?;
                let denoised = actor.denoised(critics, &s, &a, t)?;
                let size = (norm(&denoised.epsilon)? + 1e-8)?;
                let direction = denoised.epsilon.broadcast_div(&size.unsqueeze(1)?)?;
                parts.push([a, direction, gradients, mean_and_variance(&denoised.gradients)?.0]);
            }
            let all = Tensor::full(t as u32, rows, &Device::Cpu)?;
            let epsilon = actor.predict(&observations, &noisy, &all)?;
            let z = (t > 1).then(|| noise.get(steps - t + 1)).transpose()?;
            noisy = actor.schedule().reverse(t, &noisy, &epsilon, z.as_ref())?;
        }
        outside.reverse();
        if parts.is_empty() {
            candle_core::bail!("no noisy action is within ±(1 − h): take a smaller --h");
        }
        let all = |which: usize| {
            let of_steps = Vec::from_iter(parts.iter().map(|part| &part[which]));
            Tensor::cat(&of_steps, 0)?.to_dtype(DType::F64)
        };
        let (actions, directions, gradients, denoised) = (all(0)?, all(1)?, all(2)?, all(3)?);
        let scale = critics.values(&observations, &noisy)?.abs()?.mean_all()?.to_scalar::<f32>()?;
        Ok((Self { of, actions, directions, gradients, denoised }, outside, scale.into()))
    }
}

fn indices(rows: impl Iterator<Item = u32>) -> Result<Tensor> {
    Tensor::from_iter(rows, &Device::Cpu)
}

/// Sizes of the vectors along the last dimension.
pub fn norm(x: &Tensor) -> Result<Tensor> {
    x.sqr()?.sum(D::Minus1)?.sqrt()
}

/// Standard normal numbers.
pub fn normal(shape: (usize, usize, usize), random: &mut impl Rng) -> Result<Tensor> {
    let numbers = random.sample_iter::<f32, _>(StandardNormal).take(shape.0 * shape.1 * shape.2);
    Tensor::from_vec(numbers.collect(), shape, &Device::Cpu)
}
