//! The data by which policies are judged: episodes to estimate values from, and those in whose
//! states they are judged.

use std::collections::BTreeSet;
use std::sync::Arc;

use anyhow::{Context as _, anyhow};
use candle_core::Device;
use quad_algorithms::{Context, Fqe};
use quad_dataset::{
    Batch, DatasetError, HoldOut, ReadOptions, RewardRule, Scale, Split, Transitions, environment,
    ogbench,
};
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

/// Transitions in the evaluation's units: observations with mean 0 and standard deviation 1,
/// actions from −1 to 1, rewards as they were recorded.
pub(super) struct Data {
    /// SHA-256 of the file.
    pub sha256: String,
    /// The environment that its rewards are of.
    pub environment: String,
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
    /// The data that these policies have learned from. They are judged in every episode that one of
    /// their runs has held out: all in the same states.
    ///
    /// # Errors
    /// It is not on this machine, is not what they have learned from, or they have not learned from
    /// the same in one environment.
    pub fn of(subjects: &[Subject]) -> anyhow::Result<Self> {
        let first = subjects.first().ok_or_else(|| anyhow!("there is no policy to judge"))?;
        let of_first = &first.config.dataset;
        if let Some(other) =
            subjects.iter().find(|other| other.config.dataset.sha256 != of_first.sha256)
        {
            return Err(anyhow!(
                "{} and {} have not learned from the same data",
                first.run,
                other.run
            ))
            .hint("judge them apart: values that come from different data do not compare");
        }
        let environment = &first.config.experiment.environment;
        let is_of_another = |other: &&Subject| other.config.experiment.environment != *environment;
        if let Some(other) = subjects.iter().find(is_of_another) {
            let (one, of_other) = (&first.run, &other.config.experiment.environment);
            return Err(anyhow!(
                "{one} is of the environment {environment}, {} of {of_other}",
                other.run
            ))
            .hint("judge them apart: values of different rewards do not compare");
        }
        let dataset = Source::Path(of_first.path.clone()).obtain();
        let dataset = dataset.hint(format!("put the data of the run {} back", first.run))?;
        if of_first.sha256.as_ref().is_some_and(|sha256| *sha256 != dataset.sha256) {
            return Err(anyhow!(
                "{} is not the data that {} has learned from",
                dataset.path.display(),
                first.run
            ))
            .hint("put a copy of that file in its place");
        }
        let episodes = BTreeSet::from_iter(
            subjects.iter().flat_map(|subject| subject.held_out.iter().copied()),
        );
        let episodes = Vec::from_iter(episodes);
        let hold_out = match episodes.is_empty() {
            false => HoldOut::Episodes(&episodes),
            true => {
                warn!(
                    "no run has held out episodes (--hold-out), so the policies are judged in some that they have learned from"
                );
                HoldOut::Share { share: SHARE, seed: 0 }
            }
        };
        let options = ReadOptions {
            environment: environment::find(environment).ok(),
            task: ogbench::maze_task(environment),
            reward: RewardRule::AsIs,
            scale: Scale { actions: true, states: true, rewards: false },
        };
        let split = Transitions::read_split(&dataset.path, &options, hold_out);
        Self::of_split(split.hint_of(DatasetError::hint)?, dataset.sha256, environment.clone())
    }

    fn of_split(split: Split, sha256: String, environment: String) -> anyhow::Result<Self> {
        let held_out = split.held_out.context("no episode is held out")?;
        Ok(Self {
            sha256,
            environment,
            first: gather(
                &held_out,
                &Vec::from_iter(held_out.recorded_episodes().iter().map(|episode| episode.start)),
            ),
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

    /// The mean over the judged episodes of the discounted return, where the last step of one that
    /// was cut off counts what these evaluations of the behavior say of it.
    pub fn recorded_value(&self, behavior: &[&Fqe], gamma: f32) -> anyhow::Result<f64> {
        let (mut sum, episodes) = (0.0, self.held_out.recorded_episodes());
        for episode in &episodes {
            let steps = gather(&self.held_out, &Vec::from_iter(episode.clone()));
            let (o, a, last) = (
                self.held_out.observation_dim(),
                self.held_out.action_dim(),
                steps.rewards.len() - 1,
            );
            let mut value = f64::from(steps.rewards[last]);
            if steps.masks[last] != 0.0 {
                let (observation, action) =
                    (&steps.observations[last * o..], &steps.actions[last * a..]);
                let values = behavior.iter().map(|fqe| fqe.values(observation, action));
                value =
                    mean(values.collect::<candle_core::Result<Vec<_>>>()?.into_iter().flatten());
            }
            sum += steps.rewards[..last]
                .iter()
                .rev()
                .fold(value, |value, reward| f64::from(*reward) + f64::from(gamma) * value);
        }
        Ok(sum / episodes.len() as f64)
    }

    /// The distance of these actions, in the data's units, from the data's at the states that are
    /// compared.
    pub fn distance(&self, actions: &[f32]) -> f64 {
        let mut of_data = self.compared.actions.clone();
        self.held_out.scaling().actions.iter().for_each(|affine| affine.to_user(&mut of_data));
        distance(&of_data, actions, self.held_out.action_dim())
    }
}

/// The root mean square distance of a policy's actions from the data's, `width` numbers each, in
/// standard deviations of the data's, number by number; one that never changes counts in the
/// others' mean deviation, or as it is. 0 is the data; 1 is as far as the mean of all its actions
/// is.
fn distance(of_data: &[f32], of_policy: &[f32], width: usize) -> f64 {
    let columns = (0..width).map(|column| {
        let [data, policy] = [of_data, of_policy].map(|actions| {
            Vec::from_iter(actions.iter().skip(column).step_by(width).map(|x| f64::from(*x)))
        });
        let middle = mean(data.iter().copied());
        // By rounding, the deviation of equal numbers might not be 0.
        let changes = data.iter().any(|x| *x != data[0]);
        let variance = changes.then(|| mean(data.iter().map(|x| (x - middle).powi(2))));
        (mean(data.iter().zip(&policy).map(|(one, other)| (one - other).powi(2))), variance)
    });
    let columns = Vec::from_iter(columns);
    let variances = Vec::from_iter(columns.iter().filter_map(|(_, variance)| *variance));
    let of_others = if variances.is_empty() { 1.0 } else { mean(variances.into_iter()) };
    mean(columns.iter().map(|(error, variance)| error / variance.unwrap_or(of_others))).sqrt()
}

pub(super) fn mean(values: impl Iterator<Item = impl Into<f64>>) -> f64 {
    let (count, sum) =
        values.fold((0.0, 0.0), |(count, sum), value| (count + 1.0, sum + value.into()));
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

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::path::Path;

    use quad_algorithms::{FqeConfig, Units};
    use quad_dataset::{D4rlWriter, Metadata, Row};

    use super::*;

    #[test]
    fn distances_are_in_deviations_of_the_data() {
        let data = [0.0, 8.0, 2.0, 0.0, 4.0, 4.0];
        assert_eq!(distance(&data, &data, 2), 0.0);
        assert!((distance(&data, &[2.0, 4.0].repeat(3), 2) - 1.0).abs() < 1e-9, "the mean of all");
        let shifted = data.map(|x| x + 3.0);
        // Of the deviations' squares, 8/3 and 32/3.
        let expected = ((9.0 * 3.0 / 8.0 + 9.0 * 3.0 / 32.0) / 2.0_f64).sqrt();
        assert!((distance(&data, &shifted, 2) - expected).abs() < 1e-9);
    }

    #[test]
    fn a_motor_that_is_idle_in_the_data_counts_where_a_policy_moves_it() {
        let data = [0.1, 3.0, 0.1, 5.0, 0.1, 7.0];
        let idle_moves = [2.1, 3.0, 2.1, 5.0, 2.1, 7.0];
        // By 2, of the other's squared deviation, 8/3.
        let expected = (4.0 * 3.0 / 8.0 / 2.0_f64).sqrt();
        assert!((distance(&data, &idle_moves, 2) - expected).abs() < 1e-6);
        assert_eq!(distance(&data, &data, 2), 0.0);
        assert_eq!(distance(&[0.1; 3], &[3.1; 3], 1).round(), 3.0, "as it is where none changes");
    }

    /// Of Hopper's: each has these rewards, and ends by a terminal or by a timeout, of which D4RL's
    /// last row is no transition.
    fn write(path: &Path, episodes: &[(&[f64], bool)]) {
        let mut writer = D4rlWriter::create(path, environment::find("hopper").unwrap()).unwrap();
        for (episode, (rewards, terminal)) in episodes.iter().enumerate() {
            for (step, reward) in rewards.iter().enumerate() {
                let number = |at: usize, i: usize| ((10 * episode + at + 3 * i) as f64).sin();
                let observation = |at: usize| Vec::from_iter((0..11).map(|i| number(at, i)));
                let is_last = step + 1 == rewards.len();
                let row = Row {
                    observation: &observation(step),
                    action: &Vec::from_iter((0..3).map(|i| 0.9 * number(step, i))),
                    next_observation: &observation(step + 1),
                    reward: *reward,
                    terminal: is_last && *terminal,
                    timeout: is_last && !terminal,
                    qpos: &[0.0; 6],
                    qvel: &[0.0; 6],
                };
                writer.push(&row).unwrap();
            }
        }
        writer.finish(&Metadata { algorithm: "made up", iteration: 0, seed: 0 }).unwrap();
    }

    #[test]
    fn the_recorded_value_goes_on_after_an_episode_that_was_cut_off_and_only_there() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("data.hdf5");
        let rewards = [2.0, 4.0, 8.0, 16.0];
        write(&path, &[(&rewards, false), (&rewards, true), (&rewards, false)]);
        let options = ReadOptions {
            environment: environment::find("hopper").ok(),
            task: None,
            reward: RewardRule::AsIs,
            scale: Scale { actions: true, states: true, rewards: false },
        };
        let split = Transitions::read_split(&path, &options, HoldOut::Episodes(&[1, 2])).unwrap();
        let data = Data::of_split(split, String::new(), String::new()).unwrap();
        let units = Units { offset: 100.0, scale: 10.0, least: 0.0, most: 1000.0 };
        let fqe = |seed| {
            Fqe::of_behavior(FqeConfig::with_discount(0.5).unwrap(), units, data.context(seed))
                .unwrap()
        };
        let fqes = [0, 1].map(fqe);
        // Its fourth row is no transition, so that its third is the last one.
        let last = gather(&data.held_out, &[data.held_out.recorded_episodes()[1].end - 1]);
        assert_eq!(last.rewards, [8.0]);
        let of_last =
            fqes.each_ref().map(|fqe| fqe.values(&last.observations, &last.actions).unwrap()[0]);
        let after = f64::from(of_last[0] + of_last[1]) / 2.0;
        let expected = (2.0 + 2.0 + 2.0 + 2.0) / 2.0 + (2.0 + 2.0 + after / 4.0) / 2.0;
        let recorded = data.recorded_value(&fqes.each_ref(), 0.5).unwrap();
        assert!((recorded - expected).abs() < 1e-4, "{recorded} {expected}");
    }
}
