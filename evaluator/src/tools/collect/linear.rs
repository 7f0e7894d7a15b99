//! Linear policies over normalized observations.

/// a = M · (s - mean) / deviation. The environment clips it.
#[derive(Clone, Debug)]
pub struct LinearPolicy {
    /// M [action_dim, observation_dim].
    pub weights: Vec<f64>,
    pub normalizer: Normalizer,
}

impl LinearPolicy {
    pub fn zero(observation_dim: usize, action_dim: usize) -> Self {
        let (mean, inverse_deviation) = (vec![0.0; observation_dim], vec![1.0; observation_dim]);
        let weights = vec![0.0; action_dim * observation_dim];
        Self { weights, normalizer: Normalizer { mean, inverse_deviation } }
    }

    /// Writes `action`.
    pub fn act(&self, observation: &[f64], action: &mut [f32]) {
        let Normalizer { mean, inverse_deviation } = &self.normalizer;
        for (value, row) in action.iter_mut().zip(self.weights.chunks_exact(observation.len())) {
            let mut sum = 0.0;
            for (i, &observed) in observation.iter().enumerate() {
                sum += row[i] * (observed - mean[i]) * inverse_deviation[i];
            }
            *value = sum as f32;
        }
    }
}

/// Mean and inverse standard deviation of each observed value.
#[derive(Clone, Debug)]
pub struct Normalizer {
    mean: Vec<f64>,
    inverse_deviation: Vec<f64>,
}

/// Running mean and variance of observations, by Welford's recurrence; two merge by Chan's formula.
#[derive(Clone, Debug)]
pub struct Moments {
    count: f64,
    mean: Vec<f64>,
    /// Σ (s - mean)²
    squares: Vec<f64>,
}

impl Moments {
    pub fn new(observation_dim: usize) -> Self {
        let zero = vec![0.0; observation_dim];
        Self { count: 0.0, mean: zero.clone(), squares: zero }
    }

    pub fn push(&mut self, observation: &[f64]) {
        self.count += 1.0;
        for (i, value) in observation.iter().enumerate() {
            let delta = value - self.mean[i];
            self.mean[i] += delta / self.count;
            self.squares[i] += delta * (value - self.mean[i]);
        }
    }

    pub fn merge(&mut self, other: &Self) {
        let count = self.count + other.count;
        if other.count == 0.0 {
            return;
        }
        for i in 0..self.mean.len() {
            let delta = other.mean[i] - self.mean[i];
            self.mean[i] += delta * other.count / count;
            self.squares[i] += other.squares[i] + delta * delta * self.count * other.count / count;
        }
        self.count = count;
    }

    /// A value that never changes is only centered.
    pub fn normalizer(&self) -> Normalizer {
        let inverse = |squares: &f64| {
            let deviation = (squares / (self.count - 1.0).max(1.0)).sqrt();
            if deviation > 1e-7 { 1.0 / deviation } else { 1.0 }
        };
        let inverse_deviation = self.squares.iter().map(inverse).collect();
        Normalizer { mean: self.mean.clone(), inverse_deviation }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn merged_moments_are_those_of_all_observations() {
        let values = [[1.0, 5.0], [2.0, 5.0], [4.0, 5.0], [9.0, 5.0]];
        let moments = |values: &[[f64; 2]]| {
            let mut moments = Moments::new(2);
            values.iter().for_each(|value| moments.push(value));
            moments
        };
        let mut merged = moments(&values[..1]);
        merged.merge(&moments(&values[1..]));
        merged.merge(&moments(&[]));
        for moments in [moments(&values), merged] {
            let Normalizer { mean, inverse_deviation } = moments.normalizer();
            assert_eq!(mean, [4.0, 5.0]);
            // Variance 38 / 3; the second value never changed.
            assert!((inverse_deviation[0] - (3.0_f64 / 38.0).sqrt()).abs() < 1e-12);
            assert_eq!(inverse_deviation[1], 1.0);
        }
    }
}
