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
    pub fn at(t: f64) -> Self {
        let log_signal = -0.25 * t * t * (BETA.1 - BETA.0) - 0.5 * t * BETA.0;
        Self { signal: log_signal.exp(), deviation: (-(2.0 * log_signal).exp_m1()).sqrt() }
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
        Self::between(1.0, END, evaluations)
    }

    fn between(start: f64, end: f64, evaluations: usize) -> Self {
        let time = |i: usize| start + (end - start) * i as f64 / evaluations as f64;
        let (third, last): (usize, &[usize]) = match evaluations % 3 {
            0 => ((evaluations / 3).saturating_sub(1), &[2, 1]),
            1 => (evaluations / 3, &[1]),
            _ => (evaluations / 3, &[2]),
        };
        let orders = [&vec![3; third], last].concat();
        Self { times: (0..=evaluations).map(time).collect(), orders }
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
    let at: Vec<_> = times.iter().map(|t| ContinuousNoise::at(*t)).collect();
    let [start, .., end] = at[..] else { return Ok(x.clone()) };
    // Growth of λ from the start, and x by the first order.
    let growth = |to: ContinuousNoise| to.half_log_ratio() - start.half_log_ratio();
    let epsilon = noise(x, times[0])?;
    let straight = |to: ContinuousNoise| {
        (x * (to.signal / start.signal))? - (&epsilon * (to.deviation * growth(to).exp_m1()))?
    };
    // (e^h − 1)/h − 1
    let curvature = |h: f64| h.exp_m1() / h - 1.0;
    let h = growth(end);
    match at[..] {
        [_, middle, _] => {
            let change = (noise(&straight(middle)?, times[1])? - &epsilon)?;
            let factor = end.deviation * h.exp_m1() * 0.5 * h / growth(middle);
            straight(end)? - (change * factor)?
        }
        [_, middle, later, _] => {
            let (h1, h2) = (growth(middle), growth(later));
            let change = (noise(&straight(middle)?, times[1])? - &epsilon)?;
            let bent =
                (straight(later)? - (change * (h2 / h1 * later.deviation * curvature(h2)))?)?;
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
        let ContinuousNoise { signal, deviation } = ContinuousNoise::at(t);
        (x - signal * DATA.0)? * (deviation / variance(t))
    }

    fn variance(t: f64) -> f64 {
        let ContinuousNoise { signal, deviation } = ContinuousNoise::at(t);
        (signal * DATA.1).powi(2) + deviation.powi(2)
    }

    /// The exact solution, which keeps the number of standard deviations from the mean.
    fn exact(x: f64, from: f64, to: f64) -> f64 {
        let mean = |t| ContinuousNoise::at(t).signal * DATA.0;
        mean(to) + (x - mean(from)) * (variance(to) / variance(from)).sqrt()
    }

    /// The solution from x = 1.3.
    fn solve(solver: &DpmSolver) -> Result<f64> {
        solver.solve(&Tensor::new(1.3, &Device::Cpu)?, exact_noise)?.to_scalar()
    }

    /// Order 3, or order 2 with a last step of the first order.
    #[test]
    fn the_error_falls_with_the_third_power_of_the_step() -> Result<()> {
        for (left, order) in [(2, 3.0), (1, 2.0)] {
            let error = |steps: usize| {
                let solver = DpmSolver::between(0.9, 0.3, 3 * steps + left);
                Result::Ok((solve(&solver)? - exact(1.3, 0.9, 0.3)).abs())
            };
            let fall = (error(32)? / error(64)?).log2();
            assert!((fall - order).abs() < 0.35, "order {fall}");
        }
        Ok(())
    }

    #[test]
    fn the_orders_sum_up_to_the_evaluations() {
        let orders = |evaluations| DpmSolver::new(evaluations).orders;
        assert_eq!([1, 2, 3, 5].map(orders), [vec![1], vec![2], vec![2, 1], vec![3, 2]]);
        assert_eq!((orders(15), orders(16)), (vec![3, 3, 3, 3, 2, 1], vec![3, 3, 3, 3, 3, 1]));
    }

    /// Expected numbers are from a second implementation of the authors' formulas; the exact solution
    /// is 0.789.
    #[test]
    fn few_evaluations_match_the_formulas() -> Result<()> {
        for (evaluations, expected) in
            [(5, 1.1023273220338656), (6, 0.5953293444900605), (15, 0.7262775745014273)]
        {
            let found = solve(&DpmSolver::new(evaluations))?;
            assert!((found - expected).abs() < 1e-9, "{evaluations}: {found}");
        }
        Ok(())
    }
}
