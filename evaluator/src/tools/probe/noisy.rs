//! Noisy actions of a policy, and the critics' gradients there.

use candle_core::{D, DType, Device, Result, Tensor};
use quad_nn::{Ensemble, NoisePredictor, mean_and_variance};
use rand::Rng;
use rand_distr::StandardNormal;

/// Reverse processes per state. For each state and t the first of their actions that fits is taken.
const CHAINS: usize = 64;

/// An action a^t of the reverse process, and gradients of the value there.
pub struct Noisy {
    /// Index of the state.
    pub state: usize,
    pub t: usize,
    pub action: Vec<f32>,
    /// u of Eq. 21: a unit vector along the predicted noise.
    pub direction: Vec<f64>,
    /// ∇_a Q_k(s, a^t) of each critic.
    pub gradients: Vec<Vec<f64>>,
    /// The critics' mean gradient at the denoised estimate.
    pub denoised: Vec<f64>,
}

/// Draws actions that stay within ±1 if changed by `margin`, for `observations`, `[n, o]`. Also
/// returns the fraction of others for t = 1..T, and the mean of |Q_k(s, a)| over the policy's own
/// actions, by which training divides gradients.
pub fn draw(
    (actor, critics): (&NoisePredictor, &Ensemble),
    observations: &Tensor,
    margin: f32,
    random: &mut impl Rng,
) -> Result<(Vec<Noisy>, Vec<f64>, f64)> {
    let (states, shape) = (observations.dim(0)?, actor.shape());
    let (rows, steps) = (states * CHAINS, shape.diffusion_steps);
    let noise = normal((steps, rows, shape.action_dim), random)?;
    let indices =
        |rows: &[usize]| Tensor::from_iter(rows.iter().map(|row| *row as u32), &Device::Cpu);
    let of_rows = indices(&Vec::from_iter((0..rows).map(|row| row / CHAINS)))?;
    let observations = observations.index_select(&of_rows, 0)?;
    let (mut drawn, mut outside) = (Vec::new(), Vec::new());
    let mut noisy = noise.get(0)?; // a^T
    for t in (1..=steps).rev() {
        let actions: Vec<Vec<f32>> = noisy.to_vec2()?;
        let fits = |row: &usize| actions[*row].iter().all(|x| x.abs() <= 1.0 - margin);
        outside.push(1.0 - (0..rows).filter(fits).count() as f64 / rows as f64);
        let first = |state| (state * CHAINS..(state + 1) * CHAINS).find(fits);
        let kept = Vec::from_iter((0..states).filter_map(first));
        if !kept.is_empty() {
            let places = indices(&kept)?;
            let (s, a) = (observations.index_select(&places, 0)?, noisy.index_select(&places, 0)?);
            let gradients = critics.action_gradients(&s, &a)?.transpose(0, 1)?;
            let gradients = gradients.to_dtype(DType::F64)?.to_vec3::<f64>()?;
            let estimates = actor.denoised(critics, &s, &a, t)?;
            let size = (estimates.epsilon.sqr()?.sum(D::Minus1)?.sqrt()? + 1e-8)?;
            let directions = estimates.epsilon.broadcast_div(&size.unsqueeze(1)?)?;
            let directions = directions.to_dtype(DType::F64)?.to_vec2::<f64>()?;
            let denoised = mean_and_variance(&estimates.gradients)?.0;
            let denoised = denoised.to_dtype(DType::F64)?.to_vec2::<f64>()?;
            let of_rows = kept.into_iter().zip(directions).zip(denoised).zip(gradients);
            drawn.extend(of_rows.map(|(((row, direction), denoised), gradients)| {
                let (state, action) = (row / CHAINS, actions[row].clone());
                Noisy { state, t, action, direction, gradients, denoised }
            }));
        }
        let all = Tensor::full(t as u32, rows, &Device::Cpu)?;
        let epsilon = actor.predict(&observations, &noisy, &all)?;
        let z = (t > 1).then(|| noise.get(steps - t + 1)).transpose()?;
        noisy = actor.schedule().reverse(t, &noisy, &epsilon, z.as_ref())?;
    }
    outside.reverse();
    if drawn.is_empty() {
        candle_core::bail!("no noisy action is within ±(1 − h): take a smaller --h");
    }
    let scale = critics.values(&observations, &noisy)?.abs()?.mean_all()?.to_scalar::<f32>()?;
    Ok((drawn, outside, scale.into()))
}

/// Standard normal numbers.
pub fn normal(shape: (usize, usize, usize), random: &mut impl Rng) -> Result<Tensor> {
    let numbers = random.sample_iter::<f32, _>(StandardNormal).take(shape.0 * shape.1 * shape.2);
    Tensor::from_vec(numbers.collect(), shape, &Device::Cpu)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use quad_policy::{DiffusionPolicy, DiffusionShape, Precision, read_tensors};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::serve::fixtures::{file, smallest};

    /// The predicted noise is 0.
    #[test]
    fn each_reverse_step_draws_noise_of_its_own() {
        let steps = 4;
        let shape = DiffusionShape { diffusion_steps: steps, ..smallest() };
        let mut tensors = read_tensors(&file("hopper", shape.clone(), 1)).unwrap();
        let networks = DiffusionPolicy::networks(&shape, &mut tensors, Precision::F32).unwrap();
        let (actor, critics) = (networks.0, networks.1.unwrap());
        let observations = Tensor::zeros((1, 11), DType::F32, &Device::Cpu).unwrap();
        let random = || ChaCha8Rng::seed_from_u64(3);
        let (drawn, ..) = draw((&actor, &critics), &observations, 0.1, &mut random()).unwrap();

        let noise = normal((steps, CHAINS, 3), &mut random()).unwrap();
        let mut fresh = (0..steps).map(|index| noise.get(index).unwrap());
        let (mut actions, mut compared) = (fresh.next().unwrap(), 0);
        for t in (1..=steps).rev() {
            let rows: Vec<Vec<f32>> = actions.to_vec2().unwrap();
            for noisy in drawn.iter().filter(|noisy| noisy.t == t) {
                assert!(rows.contains(&noisy.action), "t = {t}");
                compared += 1;
            }
            let (epsilon, z) = (actions.zeros_like().unwrap(), fresh.next());
            actions = actor.schedule().reverse(t, &actions, &epsilon, z.as_ref()).unwrap();
        }
        assert!(compared > 1, "{compared} actions");
    }
}
