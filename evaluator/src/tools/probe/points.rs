//! Noisy actions of a policy, and the critics' gradients there.

use candle_core::{DType, Device, Result, Tensor};
use quad_nn::{Ensemble, NoisePredictor, mean_and_variance};
use rand::Rng;
use rand_distr::StandardNormal;

/// Reverse processes per state. Of each state and t the first action is taken that fits.
const CHAINS: usize = 64;

/// A noisy action a^t of the reverse process, within the range of actions.
pub struct Point {
    /// Index of its state.
    pub state: usize,
    pub t: usize,
    /// a^t.
    pub action: Vec<f32>,
    /// u of Eq. 21: the unit vector along the predicted noise.
    pub direction: Vec<f64>,
    /// ∇_a Q_k(s, a^t) of each critic.
    pub gradients: Vec<Vec<f64>>,
    /// The critics' mean gradient at the denoised estimate of a^t.
    pub denoised: Vec<f64>,
}

pub struct Points {
    pub points: Vec<Point>,
    /// Fraction of the actions that do not fit, for t = 1..T.
    pub outside: Vec<f64>,
    /// Mean of |Q_k(s, a)| over critics and the policy's own actions, by which training divides
    /// gradients.
    pub scale: f64,
}

impl Points {
    /// Draws actions that are within ±1 also after a change by `margin`, for `observations`, `[n, o]`.
    pub fn draw(
        networks @ (actor, critics): (&NoisePredictor, &Ensemble),
        observations: &Tensor,
        margin: f32,
        random: &mut impl Rng,
    ) -> Result<Self> {
        let (states, steps) = (observations.dim(0)?, actor.shape().diffusion_steps);
        let (rows, a) = (states * CHAINS, actor.shape().action_dim);
        let noise = normal((steps, rows, a), random)?;
        let of_rows = Vec::from_iter((0..rows).map(|row| (row / CHAINS) as u32));
        let repeated = observations.index_select(&Tensor::new(of_rows, &Device::Cpu)?, 0)?;
        let (mut points, mut outside) = (Vec::new(), Vec::new());
        let mut noisy = noise.get(0)?; // a^T
        for t in (1..=steps).rev() {
            let actions: Vec<Vec<f32>> = noisy.to_vec2()?;
            let fits = |row: &usize| actions[*row].iter().all(|x| x.abs() <= 1.0 - margin);
            outside.push(1.0 - (0..rows).filter(fits).count() as f64 / rows as f64);
            let first = |state| (state * CHAINS..(state + 1) * CHAINS).find(fits);
            let kept = Vec::from_iter((0..states).filter_map(first).map(|row| row as u32));
            if !kept.is_empty() {
                points.extend(points_at(networks, [&repeated, &noisy], kept, t)?);
            }
            let all = Tensor::full(t as u32, rows, &Device::Cpu)?;
            let epsilon = actor.predict(&repeated, &noisy, &all)?;
            let z = (t > 1).then(|| noise.get(steps - t + 1)).transpose()?;
            noisy = actor.schedule().reverse(t, &noisy, &epsilon, z.as_ref())?;
        }
        outside.reverse();
        let values = critics.values(&repeated, &noisy)?.abs()?.mean_all()?;
        Ok(Self { points, outside, scale: f64::from(values.to_scalar::<f32>()?) })
    }
}

/// Standard normal numbers.
pub fn normal(shape: (usize, usize, usize), random: &mut impl Rng) -> Result<Tensor> {
    let numbers = random.sample_iter::<f32, _>(StandardNormal).take(shape.0 * shape.1 * shape.2);
    Tensor::from_vec(numbers.collect(), shape, &Device::Cpu)
}

/// Points at the noisy actions, `[rows, a]`, of the `kept` rows.
fn points_at(
    (actor, critics): (&NoisePredictor, &Ensemble),
    [observations, noisy]: [&Tensor; 2],
    kept: Vec<u32>,
    t: usize,
) -> Result<Vec<Point>> {
    let rows = Tensor::new(&*kept, &Device::Cpu)?;
    let (observations, actions) =
        (observations.index_select(&rows, 0)?, noisy.index_select(&rows, 0)?);
    let gradients = critics.action_gradients(&observations, &actions)?; // [K, n, a]
    let gradients = gradients.to_dtype(DType::F64)?.to_vec3::<f64>()?;
    let denoised = actor.denoised(critics, &observations, &actions, t)?;
    let size = (denoised.epsilon.sqr()?.sum_keepdim(1)?.sqrt()? + 1e-8)?;
    let numbers = |tensor: Tensor| tensor.to_dtype(DType::F64)?.to_vec2::<f64>();
    let directions = numbers(denoised.epsilon.broadcast_div(&size)?)?;
    let denoised = numbers(mean_and_variance(&denoised.gradients)?.0)?;
    let actions = actions.to_vec2::<f32>()?;
    let point = |place: usize| Point {
        state: kept[place] as usize / CHAINS,
        t,
        action: actions[place].clone(),
        direction: directions[place].clone(),
        gradients: gradients.iter().map(|of_critic| of_critic[place].clone()).collect(),
        denoised: denoised[place].clone(),
    };
    Ok((0..kept.len()).map(point).collect())
}
