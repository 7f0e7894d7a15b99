//! The data by which policies are judged: episodes to estimate values from, and those in whose states they are judged.

use std::collections::BTreeSet;
use std::sync::Arc;

use anyhow::{Context as _, anyhow};
use candle_core::Device;
use quad_algorithms::{Context, Fqe};
use quad_dataset::{Batch, DatasetError, HoldOut, ReadOptions, RewardRule, Scale, Transitions, environment, ogbench};
use quad_policy::Precision;
use quad_runtime::Hint;
use tracing::warn;

use super::subject::Subject;
use crate::data::Source;

/// Transitions of a gradient step.
const BATCH: usize = 256;
/// The share of episodes in which policies are judged that no run has held out.
const SHARE: f64 = 0.1;
/// In how many states policies are compared with the data at most.
const COMPARED: usize = 2000;

/// Transitions in the evaluation's units: observations with mean 0 and standard deviation 1, actions from −1 to 1, rewards as they
/// were recorded.
pub(super) struct Data {
    /// SHA-256 of the file.
    pub sha256: String,
    /// To estimate values from.
    pub training: Arc<Transitions>,
    /// The first transition of each judged episode.
    pub first: Batch,
    /// Some transitions of these episodes, at whose states policies are compared with the data.
    pub compared: Batch,
    /// Numbers of the judged episodes, from 0 in the order of the file.
    pub episodes: Vec<usize>,
    held_out: Transitions,
}

impl Data {
    /// The data that these policies have learnt from. They are judged in every episode that one of their runs has held out: all in
    /// the same states.
    ///
    /// # Errors
    /// It is not on this machine, is not what they have learnt from, or they have not learnt from the same.
    pub fn of(subjects: &[Subject]) -> anyhow::Result<Self> {
        let first = subjects.first().ok_or_else(|| anyhow!("there is no policy to judge"))?;
        let of_first = &first.config.dataset;
        if let Some(other) = subjects.iter().find(|other| other.config.dataset.sha256 != of_first.sha256) {
            return Err(anyhow!("{} and {} have not learnt from the same data", first.run, other.run))
                .hint("judge them apart: values that come from different data do not compare");
        }
        let dataset = Source::Path(of_first.path.clone()).obtain();
        let dataset = dataset.hint(format!("put the data of the run {} back", first.run))?;
        if of_first.sha256.as_ref().is_some_and(|sha256| *sha256 != dataset.sha256) {
            return Err(anyhow!("{} is not the data that {} has learnt from", dataset.path.display(), first.run))
                .hint("put a copy of that file in its place");
        }
        let episodes = BTreeSet::from_iter(subjects.iter().flat_map(|subject| subject.held_out.iter().copied()));
        let episodes = Vec::from_iter(episodes);
        let hold_out = match episodes.is_empty() {
            false => HoldOut::Episodes(&episodes),
            true => {
                warn!(
                    "no run has held out episodes (--hold-out), so the policies are judged in some that they have learnt from"
                );
                HoldOut::Share { share: SHARE, seed: 0 }
            }
        };
        let options = ReadOptions {
            environment: environment::find(&first.config.experiment.environment).ok(),
            task: ogbench::maze_task(&first.config.experiment.environment),
            reward: RewardRule::AsIs,
            scale: Scale { actions: true, states: true, rewards: false },
        };
        let split = Transitions::read_split(&dataset.path, &options, hold_out);
        let split = split.hint_of(DatasetError::hint)?;
        let held_out = split.held_out.context("no episode is held out")?;
        Ok(Self {
            sha256: dataset.sha256,
            first: gather(&held_out, &Vec::from_iter(held_out.recorded_episodes().iter().map(|episode| episode.start))),
            compared: gather(&held_out, &spread(held_out.len(), COMPARED)),
            training: Arc::new(split.training),
            episodes: split.episodes,
            held_out,
        })
    }

    /// What an evaluation of this seed learns from.
    pub fn context(&self, seed: u64) -> Context {
        Context {
            transitions: self.training.clone(),
            batch_size: BATCH.min(self.training.len()),
            total_steps: 0,
            seed,
            precision: Precision::F32,
            device: Device::Cpu,
        }
    }

    /// The mean over the judged episodes of the discounted return, where the last step of one that was cut off counts what these
    /// evaluations of the behaviour say of it.
    pub fn recorded_value(&self, behavior: &[&Fqe], gamma: f32) -> anyhow::Result<f64> {
        let (mut sum, episodes) = (0.0, self.held_out.recorded_episodes());
        for episode in &episodes {
            let steps = gather(&self.held_out, &Vec::from_iter(episode.clone()));
            let (o, a, last) = (self.held_out.observation_dim(), self.held_out.action_dim(), steps.rewards.len() - 1);
            let mut value = f64::from(steps.rewards[last]);
            if steps.masks[last] != 0.0 {
                let (observation, action) = (&steps.observations[last * o..], &steps.actions[last * a..]);
                let values = behavior.iter().map(|fqe| fqe.values(observation, action));
                value = mean(values.collect::<candle_core::Result<Vec<_>>>()?.into_iter().flatten());
            }
            sum += steps.rewards[..last]
                .iter()
                .rev()
                .fold(value, |value, reward| f64::from(*reward) + f64::from(gamma) * value);
        }
        Ok(sum / episodes.len() as f64)
    }

    /// The root mean square distance of these actions from the data's at the states that are compared, in standard deviations of the
    /// data's, number by number. 0 is the data; 1 is as far as the mean of all its actions is.
    pub fn distance(&self, actions: &[f32]) -> f64 {
        let width = self.held_out.action_dim();
        let columns = (0..width).map(|column| {
            let of_data = || self.compared.actions.iter().skip(column).step_by(width).map(|x| f64::from(*x));
            let of_policy = actions.iter().skip(column).step_by(width).map(|x| f64::from(*x));
            let middle = mean(of_data());
            let variance = mean(of_data().map(|x| (x - middle).powi(2)));
            let error = mean(of_data().zip(of_policy).map(|(one, other)| (one - other).powi(2)));
            // A number that never changes has no deviation.
            if variance > 0.0 { error / variance } else { 0.0 }
        });
        mean(columns).sqrt()
    }
}

pub(super) fn mean(values: impl Iterator<Item = impl Into<f64>>) -> f64 {
    let (count, sum) = values.fold((0.0, 0.0), |(count, sum), value| (count + 1.0, sum + value.into()));
    sum / count
}

fn gather(transitions: &Transitions, rows: &[u32]) -> Batch {
    let mut batch = Batch::default();
    transitions.gather(rows, &mut batch);
    batch
}

/// Numbers below `len`, evenly, at most so many.
fn spread(len: usize, most: usize) -> Vec<u32> {
    let count = len.min(most);
    (0..count).map(|i| (i * len / count) as u32).collect()
}
