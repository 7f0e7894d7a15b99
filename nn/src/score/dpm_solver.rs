//! The noise process in continuous time, and DPM-Solver (Lu et al. 2022), which reverses it in few
//! steps.

use candle_core::{Result, Tensor};

/// Last time of sampling: at t = 0 the score is not defined.
const END: f64 = 1e-3;
/// β_t = 0.1 + 19.9·t.
const BETA: (f64, f64) = (0.1, 20.0);

/// The variance-preserving noise of time t within (0, 1]: a_t = α_t·a + σ_t·ε.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContinuousNoise {
    /// α_t = exp(-½∫β).
    pub signal: f64,
    /// σ_t = √(1 - α_t²).
    pub deviation: f64,
}

impl ContinuousNoise {
    /// The noise of time t.
    pub fn new(t: f64) -> Self {
        let log_signal = -0.25 * t * t * (BETA.1 - BETA.0) - 0.5 * t * BETA.0;
        let deviation = (-(2.0 * log_signal).exp_m1()).sqrt();
        Self { signal: log_signal.exp(), deviation }
    }

    /// λ_t = ln(α_t/σ_t).
    fn half_log_ratio(self) -> f64 {
        self.signal.ln() - self.deviation.ln()
    }
}

/// DPM-Solver-fast: steps of order 3, the last ones of lower order to match the number of
/// evaluations.
#[derive(Clone, Debug)]
pub struct DpmSolver {
    /// Times of the evaluations, and the last time.
    times: Vec<f64>,
    /// Each step's order, which is also its number of evaluations.
    orders: Vec<usize>,
}

impl DpmSolver {
    /// From t = 1 to 0.001 in at least one evaluation of the noise predictor.
    pub fn new(evaluations: usize) -> Self {
        let time = |i: usize| 1.0 + (END - 1.0) * i as f64 / evaluations as f64;
        let (third, last): (usize, &[usize]) = match evaluations % 3 {
            0 => ((evaluations / 3).saturating_sub(1), &[2, 1]),
            1 => (evaluations / 3, &[1]),
            _ => (evaluations / 3, &[2]),
        };
        let orders = [&vec![3; third], last].concat();
        let times = (0..=evaluations).map(time).collect();
        Self { times, orders }
    }

    /// Solves from x = noise at t = 1, `[rows, a]`, to the actions. `noise` predicts the noise in x
    /// at a time.
    pub fn solve(
        &self,
        x: &Tensor,
        noise: impl Fn(&Tensor, f64) -> Result<Tensor>,
    ) -> Result<Tensor> {
        let (mut x, mut first) = (x.clone(), 0);
        for order in &self.orders {
            x = step(&self.times[first..=first + order], &x, &noise)?;
            first += order;
        }
        Ok(x)
    }
}

/// One step from the first to the last of order + 1 times.
fn step(
    times: &[f64],
    x: &Tensor,
    noise: impl Fn(&Tensor, f64) -> Result<Tensor>,
) -> Result<Tensor> {
    let noises = Vec::from_iter(times.iter().map(|t| ContinuousNoise::new(*t)));
    let [start, .., end] = noises[..] else { return Ok(x.clone()) };
    // Growth of λ from the start, and x by the first order.
    let growth = |to: ContinuousNoise| to.half_log_ratio() - start.half_log_ratio();
    let epsilon = noise(x, times[0])?;
    let straight = |to: ContinuousNoise| {
        (x * (to.signal / start.signal))? - (&epsilon * (to.deviation * growth(to).exp_m1()))?
    };
    // (e^h − 1)/h − 1
    let curvature = |h: f64| h.exp_m1() / h - 1.0;
    let h = growth(end);
    match noises[..] {
        [_, middle, _] => {
            let change = (noise(&straight(middle)?, times[1])? - &epsilon)?;
            let factor = end.deviation * h.exp_m1() * 0.5 * h / growth(middle);
            straight(end)? - (change * factor)?
        }
        [_, middle, later, _] => {
            let (h1, h2) = (growth(middle), growth(later));
            let change = (noise(&straight(middle)?, times[1])? - &epsilon)?;
            let factor = h2 / h1 * later.deviation * curvature(h2);
            let bent = (straight(later)? - (change * factor)?)?;
            let change = (noise(&bent, times[2])? - &epsilon)?;
            straight(end)? - (change * (h / h2 * end.deviation * curvature(h)))?
        }
        _ => straight(end),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    /// Mean and standard deviation of normal data.
    const DATA: (f64, f64) = (0.4, 0.3);

    /// E[ε | x] at time t: σ_t·(x − α_t·mean)/variance.
    fn exact_noise(x: &Tensor, t: f64) -> Result<Tensor> {
        let ContinuousNoise { signal, deviation } = ContinuousNoise::new(t);
        (x - signal * DATA.0)? * (deviation / variance(t))
    }

    fn variance(t: f64) -> f64 {
        let ContinuousNoise { signal, deviation } = ContinuousNoise::new(t);
        (signal * DATA.1).powi(2) + deviation.powi(2)
    }

    #[test]
    fn the_orders_sum_up_to_the_evaluations() {
        let orders = |evaluations| DpmSolver::new(evaluations).orders;
        let few = [vec![1], vec![2], vec![2, 1], vec![3, 2]];
        assert_eq!([1, 2, 3, 5].map(orders), few);
        assert_eq!(orders(15), [3, 3, 3, 3, 2, 1]);
        assert_eq!(orders(16), [3, 3, 3, 3, 3, 1]);
    }

    /// Expected numbers are from a second implementation of the authors' formulas; the exact solution
    /// from x = 1.3 is 0.789.
    #[test]
    fn few_evaluations_match_the_formulas() -> Result<()> {
        let x = Tensor::new(1.3, &Device::Cpu)?;
        for (evaluations, expected) in
            [(5, 1.1023273220338656), (6, 0.5953293444900605), (15, 0.7262775745014273)]
        {
            let solved = DpmSolver::new(evaluations).solve(&x, exact_noise)?;
            let error = solved.to_scalar::<f64>()? - expected;
            assert!(error.abs() < 1e-9, "{evaluations}: {error}");
        }
        Ok(())
    }
}
