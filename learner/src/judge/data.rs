//! The dataset by which policies are judged: episodes to train on, and held-out ones.

use std::collections::BTreeSet;
use std::sync::Arc;

use anyhow::{Context as _, anyhow};
use candle_core::Device;
use quad_algorithms::{AlgorithmError, Columns, Context, Examples, Fqe};
use quad_dataset::{
    Batch, BatchSampler, DatasetError, HoldOut, Normalize, ReadOptions, RewardRule, Split,
    Transitions, Window, benchmarks, environment,
};
use quad_policy::Precision;
use quad_runtime::Hint;
use tracing::warn;

use super::snapshots::Snapshot;
use crate::data::Source;

const BATCH_SIZE: usize = 256;
/// Share of the episodes that are held out where no run has done so.
const HELD_OUT: f64 = 0.1;
/// Most states where policies are compared with the data.
const COMPARED: usize = 2000;

/// Transitions with standardized observations, actions from −1 to 1, and rewards as recorded.
pub(super) struct Data {
    pub sha256: String,
    pub environment: String,
    pub training: Arc<Transitions>,
    /// The first transition of each judged episode.
    pub first: Batch,
    /// Held-out transitions at whose states policies are compared with the data.
    pub compared: Batch,
    /// Numbers of the judged episodes in the file, from 0.
    pub episodes: Vec<usize>,
    held_out: Transitions,
}

impl Data {
    /// Reads the data of these snapshots, from `dataset` if it is there. They are judged in the episodes
    /// that every run with held-out episodes has held out.
    pub fn read(snapshots: &[Snapshot], dataset: Option<&str>) -> anyhow::Result<Self> {
        let first = snapshots.first().context("there is no policy to judge")?;
        let (run, data) = (first.folder.path().display(), &first.config.dataset);
        let environment = &first.config.experiment.environment;
        for Snapshot { folder, config, .. } in snapshots {
            let (other, theirs) = (folder.path().display(), &config.experiment.environment);
            if config.dataset.sha256 != data.sha256 {
                let error = anyhow!("{run} and {other} have not learned from the same data");
                return Err(error)
                    .hint("judge them apart: values that come from different data do not compare");
            }
            if theirs != environment {
                let others = format!("{other} of {theirs}");
                return Err(anyhow!("{run} is of the environment {environment}, {others}"))
                    .hint("judge them apart: values of different rewards do not compare");
            }
        }
        let source = dataset.map_or_else(|| Ok(Source::Path(data.path.clone())), Source::parse)?;
        let hint = format!(
            "name the data of the run {run} by --dataset; a relative path in the run is below the folder where `learner train` was started"
        );
        let dataset = source.obtain().hint(hint)?;
        if data.sha256.is_some() && data.sha256 != Some(dataset.sha256.clone()) {
            let path = dataset.path.display();
            let error = anyhow!("{path} is not the data that {run} has learned from");
            return Err(error).hint("name a copy of that file by --dataset");
        }
        let episodes = shared(snapshots.iter().map(|snapshot| &snapshot.held_out))?;
        let hold_out = match &episodes {
            Some(episodes) => HoldOut::Episodes(episodes),
            None => {
                warn!(
                    "no run has held out episodes (--hold-out), so the policies are judged in some that they have learned from"
                );
                HoldOut::Fraction(HELD_OUT)
            }
        };
        let options = ReadOptions {
            environment: environment::find(environment).ok(),
            task: benchmarks::relabeling(environment),
            reward: RewardRule::AsIs,
            normalize: Normalize { actions: true, observations: true, rewards: false },
            ..ReadOptions::default()
        };
        let split = Transitions::read_split(&dataset.path, &options, hold_out)
            .hint_of(DatasetError::hint)?;
        Self::of(split, dataset.sha256, environment.clone())
    }

    pub(super) fn of(split: Split, sha256: String, environment: String) -> anyhow::Result<Self> {
        let held_out = split.held_out.context("no episode is left to judge policies in").hint(
            "record more: they are judged in other episodes than those from which values are learned",
        )?;
        let episodes = held_out.recorded_episodes();
        let starts = Vec::from_iter(episodes.iter().map(|episode| episode.start));
        // At even distances.
        let count = held_out.len().min(COMPARED);
        let compared = Vec::from_iter((0..count).map(|i| (i * held_out.len() / count) as u32));
        Ok(Self {
            sha256,
            environment,
            first: held_out.gather(&starts),
            compared: held_out.gather(&compared),
            training: Arc::new(split.training),
            episodes: split.episodes,
            held_out,
        })
    }

    pub fn context(&self, seed: u64) -> Context {
        Context {
            transitions: self.training.clone(),
            total_steps: 0,
            online_steps: 0,
            window: Window::ONE,
            seed,
            precision: Precision::F32,
            device: Device::Cpu,
        }
    }

    /// The training transitions with these columns.
    pub fn examples(&self, columns: Columns) -> anyhow::Result<Examples> {
        let examples = Examples::new(self.training.clone(), columns, Window::ONE);
        examples.hint_of(AlgorithmError::hint)
    }

    /// Draws batches of these examples.
    pub fn sampler(&self, examples: &Examples, seed: u64) -> BatchSampler {
        let batch_size = BATCH_SIZE.min(self.training.len());
        BatchSampler::new(examples.len(), batch_size, seed, 0)
    }

    /// Mean discounted return of the judged episodes. The last step of a truncated episode counts
    /// its estimated value: the mean of these evaluations of the behavior policy.
    pub fn recorded_value(&self, behavior: &[Fqe], gamma: f32) -> anyhow::Result<f64> {
        let (o, a) = (self.held_out.observation_dim(), self.held_out.action_dim());
        let mut returns = Vec::new();
        for episode in self.held_out.recorded_episodes() {
            let steps = self.held_out.gather(&Vec::from_iter(episode));
            let last = steps.rewards.len() - 1;
            let mut value = f64::from(steps.rewards[last]);
            if steps.masks[last] != 0.0 {
                let (s, a) = (&steps.observations[last * o..], &steps.actions[last * a..]);
                let values = behavior.iter().map(|fqe| fqe.values(s, a));
                value = mean(values.collect::<candle_core::Result<Vec<_>>>()?.concat());
            }
            for reward in steps.rewards[..last].iter().rev() {
                value = f64::from(*reward) + f64::from(gamma) * value;
            }
            returns.push(value);
        }
        Ok(mean(returns))
    }

    /// Distance of a policy's actions from the data's at the compared states.
    pub fn distance(&self, actions: &[f32]) -> f64 {
        let mut recorded = self.compared.actions.clone();
        if let Some(affine) = &self.held_out.scaling().actions {
            affine.to_user(&mut recorded);
        }
        distance(&recorded, actions, self.held_out.action_dim())
    }
}

/// The episodes that these runs have held out, if any has; those of older runs depend on their seed.
fn shared<'a>(
    held_out: impl Iterator<Item = &'a BTreeSet<usize>>,
) -> anyhow::Result<Option<Vec<usize>>> {
    let held_out = held_out.filter(|episodes| !episodes.is_empty());
    let Some(shared) = held_out.cloned().reduce(|a, b| &a & &b) else { return Ok(None) };
    if shared.is_empty() {
        return Err(anyhow!("no episode is held out by all of these runs")).hint(
            "judge them apart; runs that begin now hold out the same episodes, whatever their seed",
        );
    }
    Ok(Some(Vec::from_iter(shared)))
}

/// Root mean square distance of a policy's actions `[n, a]` from the data's, in standard deviations
/// of the data's columns: 0 is the data, 1 as far as the mean of all its actions. A constant column
/// counts in the mean deviation of the others, or as it is.
fn distance(data: &[f32], policy: &[f32], action_dim: usize) -> f64 {
    let (mut errors, mut variances) = (Vec::new(), Vec::new());
    for column in 0..action_dim {
        let [data, policy] = [data, policy].map(|actions| {
            let column = actions.iter().skip(column).step_by(action_dim);
            Vec::from_iter(column.map(|x| f64::from(*x)))
        });
        errors.push(mean(data.iter().zip(&policy).map(|(x, y)| (x - y).powi(2))));
        let center = mean(data.iter().copied());
        // By rounding, the variance of equal numbers might not be 0.
        let varies = data.iter().any(|x| *x != data[0]);
        variances.push(varies.then(|| mean(data.iter().map(|x| (x - center).powi(2)))));
    }
    let known = Vec::from_iter(variances.iter().copied().flatten());
    let typical = if known.is_empty() { 1.0 } else { mean(known) };
    let scaled = |(error, v): (f64, Option<f64>)| error / v.unwrap_or(typical);
    mean(errors.into_iter().zip(variances).map(scaled)).sqrt()
}

pub(super) fn mean(values: impl IntoIterator<Item = impl Into<f64>>) -> f64 {
    let (mut count, mut sum) = (0.0, 0.0);
    for value in values {
        count += 1.0;
        sum += value.into();
    }
    sum / count
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use quad_algorithms::{FqeConfig, Units};
    use quad_dataset::Arrays;

    use super::*;

    #[test]
    fn distances_are_in_standard_deviations() {
        let data = [0.0, 8.0, 2.0, 0.0, 4.0, 4.0];
        let shifted = data.map(|x| x + 3.0);
        let constant = [0.1, 3.0, 0.1, 5.0, 0.1, 7.0];
        let moved = [2.1, 3.0, 2.1, 5.0, 2.1, 7.0];
        // Variances: 8/3 and 32/3; 8/3 beside the constant column.
        for (data, policy, action_dim, expected) in [
            (&data[..], &data[..], 2, 0.0),
            (&data, &[2.0, 4.0, 2.0, 4.0, 2.0, 4.0], 2, 1.0),
            (&data, &shifted, 2, (9.0 * 15.0 / 64.0f64).sqrt()),
            (&constant, &constant, 2, 0.0),
            (&constant, &moved, 2, (4.0 * 3.0 / 16.0f64).sqrt()),
            (&[0.0; 3], &[3.0; 3], 1, 3.0),
        ] {
            let found = distance(data, policy, action_dim);
            assert!((found - expected).abs() < 1e-6, "{found} is not {expected}");
        }
    }

    #[test]
    fn runs_are_judged_in_the_episodes_that_all_have_held_out() {
        let sets = |sets: &[&[usize]]| -> Vec<BTreeSet<usize>> {
            sets.iter().map(|set| set.iter().copied().collect()).collect()
        };
        let shared = |held_out: &[&[usize]]| shared(sets(held_out).iter());
        assert_eq!(shared(&[&[], &[]]).unwrap(), None);
        assert_eq!(shared(&[&[7, 3], &[3, 5, 7], &[]]).unwrap(), Some(vec![3, 7]));
        // Older runs drew theirs by the seed.
        let error = shared(&[&[1], &[2]]).unwrap_err();
        assert_eq!(error.to_string(), "no episode is held out by all of these runs");
    }

    #[test]
    fn truncated_episodes_continue_by_the_estimate() {
        let transitions = |ends: &[bool]| {
            let rows = 3 * ends.len();
            let wave = |at: usize| (at as f32).sin();
            let last = |row: usize| row % 3 == 2;
            Transitions::of(Arrays {
                observation_dim: 1,
                action_dim: 1,
                observations: (0..rows).map(wave).collect(),
                actions: (0..rows).map(|row| 0.9 * wave(2 * row)).collect(),
                rewards: [2.0, 4.0, 8.0].repeat(ends.len()),
                next_observations: (1..=rows).map(wave).collect(),
                terminals: (0..rows).map(|row| last(row) && ends[row / 3]).collect(),
                timeouts: (0..rows).map(|row| last(row) && !ends[row / 3]).collect(),
            })
            .unwrap()
        };
        let (training, held_out) = (transitions(&[false]), Some(transitions(&[true, false])));
        let episodes = vec![1, 2];
        let split = Split { training, held_out, episodes };
        let data = Data::of(split, String::new(), String::new()).unwrap();
        let units = Units { offset: 100.0, scale: 10.0, least: 0.0, most: 1000.0 };
        let fqes = [0, 1].map(|seed| {
            let config = FqeConfig::with_discount(0.5).unwrap();
            Fqe::new(config, units, data.context(seed)).unwrap()
        });
        let recorded = data.recorded_value(&fqes, 0.5).unwrap();
        let last = data.held_out.gather(&[5]);
        let values = fqes.map(|fqe| fqe.values(&last.observations, &last.actions).unwrap());
        let after = mean(values.concat());
        let expected = (2.0 + 2.0 + 2.0 + 2.0 + 2.0 + after / 4.0) / 2.0;
        assert!((recorded - expected).abs() < 1e-4, "{recorded}, {expected}");
    }

    #[test]
    fn states_to_compare_in_are_from_all_held_out_episodes() {
        let numbered = |rows: usize| {
            let row = |row: usize| row as f32;
            Transitions::of(Arrays {
                observation_dim: 1,
                action_dim: 1,
                observations: (0..rows).map(row).collect(),
                actions: vec![0.5; rows],
                rewards: vec![0.0; rows],
                next_observations: (1..=rows).map(row).collect(),
                terminals: (0..rows).map(|row| row % 10 == 9).collect(),
                timeouts: vec![false; rows],
            })
            .unwrap()
        };
        let held_out = Some(numbered(2 * COMPARED));
        let split = Split { training: numbered(10), held_out, episodes: Vec::new() };
        let compared = Data::of(split, String::new(), String::new()).unwrap().compared;
        let expected = Vec::from_iter((0..COMPARED).map(|i| 2.0 * i as f32));
        assert_eq!(compared.observations, expected);
    }
}
