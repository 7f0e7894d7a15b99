//! Tells a state that is stored twice, with some noise between the copies, from two states.

/// Distances are in root mean square steps, each dimension by its own.
#[derive(Clone, Debug, Default)]
pub(crate) struct SameState {
    steps: Vec<f64>,
    tolerance: f64,
}

/// Bounds of the tolerance: that of exact copies, and what no longer tells a reset from a step.
const LEAST: f64 = 0.01;
const MOST: f64 = 0.5;
/// Tolerance per first quartile of the distances: most rows lead to the next, with the same noise.
/// A normal distribution's largest of a million is 16 quartiles away.
const QUARTILES: f64 = 20.0;

impl SameState {
    /// Measures observations before and after each row's step, both N × `width`.
    pub(crate) fn between(observations: &[f32], next_observations: &[f32], width: usize) -> Self {
        let (mut squares, mut counts) = (vec![0.0; width], vec![0.0_f64; width]);
        for (i, (from, to)) in observations.iter().zip(next_observations).enumerate() {
            let square = (f64::from(*to) - f64::from(*from)).powi(2);
            if square.is_finite() {
                squares[i % width] += square;
                counts[i % width] += 1.0;
            }
        }
        let means = squares.iter().zip(counts).map(|(sum, count)| sum / count);
        let (steps, tolerance) = (means.map(f64::sqrt).collect(), 0.0);
        let mut same = Self { steps, tolerance };
        let following = observations.chunks_exact(width).skip(1);
        let pairs = next_observations.chunks_exact(width).zip(following);
        let mut distances = Vec::from_iter(pairs.map(|(next, start)| same.distance(next, start)));
        let quarter = distances.len() / 4;
        if !distances.is_empty() {
            let (_, quartile, _) = distances.select_nth_unstable_by(quarter, f64::total_cmp);
            same.tolerance = match *quartile < MOST {
                true => (QUARTILES * *quartile).clamp(LEAST, MOST),
                // Rows out of order, of which none leads to the next.
                false => LEAST,
            };
        }
        same
    }

    pub(crate) fn differ(&self, a: &[f32], b: &[f32]) -> bool {
        self.distance(a, b) > self.tolerance
    }

    /// Root mean square over the dimensions.
    fn distance(&self, a: &[f32], b: &[f32]) -> f64 {
        let apart = a.iter().zip(b).map(|(a, b)| f64::from(*a) - f64::from(*b));
        let moved = apart.zip(&self.steps).filter(|(apart, _)| *apart != 0.0);
        let squares: f64 = moved.map(|(apart, step)| (apart / step).powi(2)).sum();
        (squares / self.steps.len() as f64).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Walks of 30 steps of about 0.1 that begin up to `reset` steps away from where the one before
    /// ended, stored `unit` times as large, with noise of so many steps; the rows that are ends.
    fn ends(reset: f32, noise: f32, unit: f32) -> Vec<usize> {
        let (mut state, mut observations, mut next_observations) = ([0.0_f32; 2], vec![], vec![]);
        for row in 0..1200 {
            let wave = |i: usize| (row as f32 * 1.7 + 2.0 * i as f32).sin();
            observations.extend(state.map(|x| unit * x));
            state = [state[0] + 0.14 * wave(0), state[1] + 0.14 * wave(1)];
            let copy = |i: usize| unit * (state[i] + 0.1 * noise * wave(3 * i + 1));
            next_observations.extend([copy(0), copy(1)]);
            if row % 30 == 29 {
                state = [state[0] + 0.1 * reset, state[1] - 0.1 * reset];
            }
        }
        let same = SameState::between(&observations, &next_observations, 2);
        let differs = |row: &usize| {
            let (next, start) = (&next_observations[2 * row..], &observations[2 * row + 2..]);
            same.differ(&next[..2], &start[..2])
        };
        (0..1199).filter(differs).collect()
    }

    #[test]
    fn resets_are_told_from_noise_in_any_unit() {
        let expected = Vec::from_iter((29..1199).step_by(30));
        for unit in [1e-6, 1.0, 1e6] {
            let resets = [20.0, 0.05, 20.0, 2.0, 5.0, 1.2];
            for (reset, noise) in resets.into_iter().zip([0.0, 0.0, 0.001, 0.03, 0.1, 0.2]) {
                assert_eq!(ends(reset, noise, unit), expected, "{reset}, {noise}");
            }
            assert_eq!(ends(0.001, 0.0, unit), [0; 0], "no reset, but rounding");
        }
    }
}
