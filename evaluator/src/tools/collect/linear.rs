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
        let weights = vec![0.0; action_dim * observation_dim];
        let mean = vec![0.0; observation_dim];
        let inverse_std = vec![1.0; observation_dim];
        let normalizer = Normalizer { mean, inverse_std };
        Self { weights, normalizer }
    }

    /// Writes `action`.
    pub fn act(&self, observation: &[f64], action: &mut [f32]) {
        let Normalizer { mean, inverse_std } = &self.normalizer;
        let rows = self.weights.chunks_exact(observation.len());
        for (value, row) in action.iter_mut().zip(rows) {
            let mut sum = 0.0;
            for (i, &observed) in observation.iter().enumerate() {
                sum += row[i] * (observed - mean[i]) * inverse_std[i];
            }
            *value = sum as f32;
        }
    }
}

/// Mean and inverse standard deviation of each observed value.
#[derive(Clone, Debug)]
pub struct Normalizer {
    mean: Vec<f64>,
    inverse_std: Vec<f64>,
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
        let [mean, squares] = [(); 2].map(|_| vec![0.0; observation_dim]);
        Self { count: 0.0, mean, squares }
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
            let std = (squares / (self.count - 1.0).max(1.0)).sqrt();
            if std > 1e-7 { 1.0 / std } else { 1.0 }
        };
        let inverse_std = self.squares.iter().map(inverse).collect();
        let mean = self.mean.clone();
        Normalizer { mean, inverse_std }
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
            let Normalizer { mean, inverse_std } = moments.normalizer();
            assert_eq!(mean, [4.0, 5.0]);
            // Variance 38 / 3; the second value never changed.
            assert!((inverse_std[0] - (3.0_f64 / 38.0).sqrt()).abs() < 1e-12);
            assert_eq!(inverse_std[1], 1.0);
        }
    }
}
