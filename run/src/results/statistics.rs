//! Statistics over runs. Random ones have a fixed seed.
//!
//! Statistics over tasks are those of Agarwal et al. 2021, "Deep reinforcement learning at the edge
//! of the statistical precipice" (NeurIPS), as its authors' library rliable computes them. Strata are
//! the tasks: each has the same weight, however many seeds it has.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// Resamples of an interval, and sign flips of a p-value that is not exact.
pub const RESAMPLES: usize = 10_000;
/// Pairs up to which all sign flips are tried.
const EXACT_PAIRS: usize = 16;
const SEED: u64 = 0;

/// Values of a method's runs: a nonempty list for each task, with a value for each seed.
pub type Runs<T = f64> = Vec<Vec<T>>;

/// A statistic and its 95 % interval, which is absent if a task has a single seed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// The statistic of the runs.
    pub value: f64,
    /// 2.5 % of the resamples are below.
    pub low: Option<f64>,
    /// 2.5 % of the resamples are above.
    pub high: Option<f64>,
}

impl Estimate {
    /// `value [low, high]`.
    pub fn text(self, digits: usize) -> String {
        let interval = |(low, high)| format!(" [{low:.digits$}, {high:.digits$}]");
        let interval = self.low.zip(self.high).map(interval);
        format!("{:.digits$}{}", self.value, interval.unwrap_or_default())
    }
}

/// The mean; NaN of nothing.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Mean and standard deviation of some values.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// The mean.
    pub mean: f64,
    /// Sample standard deviation (divided by n - 1); absent for a single value.
    pub std: Option<f64>,
    /// Population standard deviation (divided by n), as in DAC's code; absent for a single value.
    pub population_std: Option<f64>,
}

impl Spread {
    /// Spread of some values; `None` without any.
    pub fn new(values: &[f64]) -> Option<Self> {
        if values.is_empty() {
            return None;
        }
        let (mean, count) = (mean(values), values.len() as f64);
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let std = |divisor: f64| (values.len() > 1).then(|| (squares / divisor).sqrt());
        Some(Self { mean, std: std(count - 1.0), population_std: std(count) })
    }

    /// `mean ± std`, by n - 1.
    pub fn text(self) -> String {
        let std = self.std.map(|std| format!(" ± {std:.2}"));
        format!("{:.2}{}", self.mean, std.unwrap_or_default())
    }

    /// `mean ± std (std)`, by n - 1 and by n.
    pub fn text_with_population(self) -> String {
        let population = self.population_std.map(|std| format!(" ({std:.2})"));
        self.text() + &population.unwrap_or_default()
    }
}

/// The mean over tasks of a statistic of a task.
fn over_tasks(scores: &Runs, statistic: impl Fn(&[f64]) -> f64) -> f64 {
    scores.iter().map(|task| statistic(task)).sum::<f64>() / scores.len() as f64
}

/// The mean over tasks of the mean over seeds.
pub fn mean_of_means(scores: &Runs) -> f64 {
    over_tasks(scores, mean)
}

/// The median over tasks of the mean over seeds.
pub fn median_of_means(scores: &Runs) -> f64 {
    let mut means: Vec<f64> = scores.iter().map(|task| mean(task)).collect();
    means.sort_by(f64::total_cmp);
    percentile(&means, 0.5)
}

/// The mean of max(1 − score / 100, 0), the distance to an expert's score.
pub fn optimality_gap(scores: &Runs) -> f64 {
    let gap = |score: &f64| (1.0 - score / 100.0).max(0.0);
    over_tasks(scores, |task| task.iter().map(gap).sum::<f64>() / task.len() as f64)
}

/// The interquartile mean (IQM): the mean of all n scores without the lowest and the highest ⌊n / 4⌋.
///
/// If tasks have unequal numbers of seeds, a score has the weight of its task divided by them, and
/// ⌊n / 4⌋ / n of the weight is cut at either end.
pub fn interquartile_mean(scores: &Runs) -> f64 {
    let weigh = |task: &Vec<f64>| 1.0 / (task.len() * scores.len()) as f64;
    let mut weighed: Vec<_> =
        scores.iter().flat_map(|task| task.iter().map(|s| (*s, weigh(task)))).collect();
    weighed.sort_by(|(one, _), (other, _)| one.total_cmp(other));
    let cut = (weighed.len() / 4) as f64 / weighed.len() as f64;
    let (mut below, mut sum) = (0.0f64, 0.0);
    for (score, weight) in weighed {
        let kept = (below + weight).min(1.0 - cut) - below.max(cut);
        sum += score * kept.max(0.0);
        below += weight;
    }
    sum / (1.0 - 2.0 * cut)
}

/// A point of the performance profile: the fraction of runs that score more than `threshold`.
pub fn fraction_above(scores: &Runs, threshold: f64) -> f64 {
    let count = |task: &[f64]| task.iter().filter(|score| **score > threshold).count();
    over_tasks(scores, |task| count(task) as f64 / task.len() as f64)
}

/// The mean over tasks of P(X > Y), the probability that a run of one method scores more than a run
/// of another. Equal scores count half: it is the U of Mann and Whitney (1947) divided by the number
/// of pairs. Both methods have the same tasks.
pub fn probability_of_improvement(x: &Runs, y: &Runs) -> f64 {
    let half = |is_more| 0.5 * f64::from(u8::from(is_more));
    let wins = |x: f64, y: f64| half(x > y) + half(x >= y);
    let share = |(x, y): (&Vec<f64>, &Vec<f64>)| {
        let won: f64 = x.iter().flat_map(|x| y.iter().map(|y| wins(*x, *y))).sum();
        won / (x.len() * y.len()) as f64
    };
    x.iter().zip(y).map(share).sum::<f64>() / x.len() as f64
}

/// Statistics of methods' runs with 95 % percentile intervals of the stratified bootstrap, which draws
/// seeds with replacement within each method and task.
pub fn estimates<T: Copy>(
    methods: &[&Runs<T>],
    statistics: impl Fn(&[Runs<T>]) -> Vec<f64>,
) -> Vec<Estimate> {
    let mut drawn: Vec<Runs<T>> = methods.iter().map(|runs| (*runs).clone()).collect();
    let values = statistics(&drawn);
    let estimate = |value, low, high| Estimate { value, low, high };
    if methods.iter().copied().flatten().any(|task| task.len() < 2) {
        let alone = |value| estimate(value, None, None);
        return values.into_iter().map(alone).collect();
    }
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let mut resampled = vec![Vec::with_capacity(RESAMPLES); values.len()];
    for _ in 0..RESAMPLES {
        let tasks = methods.iter().copied().flatten();
        for (drawn, runs) in drawn.iter_mut().flatten().zip(tasks) {
            drawn.fill_with(|| runs[random.random_range(0..runs.len())]);
        }
        for (values, value) in resampled.iter_mut().zip(statistics(&drawn)) {
            values.push(value);
        }
    }
    let with_interval = |(value, mut drawn): (f64, Vec<f64>)| {
        drawn.sort_by(f64::total_cmp);
        let [low, high] = [0.025, 0.975].map(|share| Some(percentile(&drawn, share)));
        estimate(value, low, high)
    };
    values.into_iter().zip(resampled).map(with_interval).collect()
}

/// The percentile of sorted values, interpolated linearly.
fn percentile(sorted: &[f64], share: f64) -> f64 {
    let position = share * (sorted.len() - 1) as f64;
    let [below, above] = [position.floor(), position.ceil()].map(|index| sorted[index as usize]);
    below + (above - below) * position.fract()
}

/// The two-sided p-value of paired differences under the hypothesis of mean 0: the fraction of sign
/// assignments whose mean is as far from 0 as the observed one (Fisher 1935, "The design of
/// experiments", section 21). For more than 16 pairs, 10,000 assignments are drawn, and the observed
/// one is counted with them (Phipson and Smyth 2010).
pub fn sign_flip_test(differences: &[f64]) -> f64 {
    // Rounding depends on the order of a sum.
    let extreme = differences.iter().sum::<f64>().abs() * (1.0 - 1e-12);
    let is_as_far = |is_flipped: &mut dyn FnMut(usize) -> bool| {
        let signed = differences.iter().enumerate();
        let signed = signed.map(|(pair, d)| if is_flipped(pair) { -d } else { *d });
        signed.sum::<f64>().abs() >= extreme
    };
    if differences.len() <= EXACT_PAIRS {
        let ways = 1u32 << differences.len();
        let as_far = (0..ways).filter(|way| is_as_far(&mut |pair| way >> pair & 1 == 1)).count();
        return as_far as f64 / f64::from(ways);
    }
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let as_far = (0..RESAMPLES).filter(|_| is_as_far(&mut |_| random.random())).count();
    (as_far + 1) as f64 / (RESAMPLES + 1) as f64
}

/// p-values corrected for their number by Holm's procedure (1979, "A simple sequentially rejective
/// multiple test procedure"): the i-th smallest of m is multiplied by m − i + 1, and is at least the
/// one before.
pub fn holm(p_values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p_values.len()).collect();
    order.sort_by(|one, other| p_values[*one].total_cmp(&p_values[*other]));
    let mut corrected = vec![0.0; p_values.len()];
    let mut least = 0.0f64;
    for (rank, index) in order.into_iter().enumerate() {
        least = least.max(p_values[index] * (p_values.len() - rank) as f64).min(1.0);
        corrected[index] = least;
    }
    corrected
}

#[cfg(test)]
mod tests;
