//! Recorded actions in states like those of the probe.

use std::path::Path;

use quad_dataset::{Batch, DatasetError, EnvironmentSpec, ReadOptions, Transitions, benchmarks};

/// Number of most similar recorded states.
const SIMILAR: usize = 32;

pub struct Recorded {
    observations: Vec<f32>,
    actions: Vec<f32>,
    /// Standard deviation of each number of an observation.
    scale: Vec<f32>,
}

impl Recorded {
    pub fn read(path: &Path, spec: &'static EnvironmentSpec) -> Result<Self, DatasetError> {
        let task = benchmarks::relabeling(&spec.name);
        let options = ReadOptions { environment: Some(spec), task, ..ReadOptions::default() };
        let (all, mut rows) = (Transitions::read(path, &options)?, Batch::default());
        all.gather(&Vec::from_iter(0..all.len() as u32), &mut rows);
        let scale = all.standard_units().observations.map_or(Vec::new(), |units| units.scale);
        Ok(Self { observations: rows.observations, actions: rows.actions, scale })
    }

    /// Distances of `actions` to the nearest action of the recorded states that are most similar to
    /// an observation.
    pub fn distances(&self, observation: &[f32], actions: &[Vec<f32>]) -> Vec<f64> {
        let difference = |state: &[f32]| {
            let numbers = state.iter().zip(observation).zip(&self.scale);
            let varying = numbers.filter(|(_, scale)| **scale > 0.0);
            varying.map(|((x, y), scale)| ((x - y) / scale).powi(2)).sum::<f32>()
        };
        let states = self.observations.chunks_exact(observation.len());
        let mut states = Vec::from_iter(states.map(difference).enumerate());
        let similar = SIMILAR.min(states.len());
        states.select_nth_unstable_by(similar - 1, |one, other| one.1.total_cmp(&other.1));
        let distance = |action: &Vec<f32>| {
            let of_state = |(row, _): &(usize, f32)| {
                let pairs = action.iter().zip(&self.actions[row * action.len()..]);
                pairs.map(|(x, y)| f64::from(x - y).powi(2)).sum::<f64>().sqrt()
            };
            states[..similar].iter().map(of_state).fold(f64::INFINITY, f64::min)
        };
        actions.iter().map(distance).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The second dimension varies ten times as much; the third is constant.
    #[test]
    fn distances_are_to_actions_in_similar_states() {
        let count = 2 * SIMILAR;
        let observations =
            (0..count).flat_map(|i| [i as f32, 10.0 * (i % 2) as f32, 5.0]).collect();
        let actions = (0..count).flat_map(|i| [i as f32, 0.0]).collect();
        let recorded = Recorded { observations, actions, scale: vec![1.0, 1e4, 0.0] };
        let distances = recorded.distances(&[0.0, 0.0, 9.0], &[vec![34.0, 4.0], vec![2.5, 0.0]]);
        assert_eq!(distances, [5.0, 0.5]);
    }
}
