//! The critics' target: a lower confidence bound on the next state's value (Eq. 20).

use super::TargetReduce;

/// y = r + γ·mask·Q_LCB(s', a'), B numbers.
///
/// `values` is `K × B × S`: the target critics' values of the sampled next actions. Each sample's bound is the mean
/// over the critics minus ρ population standard deviations; a state's samples are then reduced to one.
pub(super) struct LowerConfidenceBound {
    pub gamma: f32,
    pub rho: f32,
    pub samples: usize,
    pub reduce: TargetReduce,
}

impl LowerConfidenceBound {
    pub fn targets(&self, values: &[f32], rewards: &[f32], masks: &[f32], targets: &mut Vec<f32>) {
        let rows = rewards.len() * self.samples;
        let critics = (values.len() / rows) as f32;
        let bound = |row: usize| {
            let each = values.iter().skip(row).step_by(rows);
            let mean = each.clone().sum::<f32>() / critics;
            let variance = each.map(|q| (q - mean).powi(2)).sum::<f32>() / critics;
            mean - self.rho * variance.sqrt()
        };
        targets.clear();
        for (i, (reward, mask)) in rewards.iter().zip(masks).enumerate() {
            let bounds = (i * self.samples..(i + 1) * self.samples).map(bound);
            let value = match self.reduce {
                TargetReduce::Mean => bounds.sum::<f32>() / self.samples as f32,
                TargetReduce::Max => bounds.fold(f32::NEG_INFINITY, f32::max),
            };
            targets.push(reward + self.gamma * mask * value);
        }
    }
}
