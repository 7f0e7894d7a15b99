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
use quad_run::results::statistics::mean;
use quad_run::results::{Conditions, Spread};
use quad_runtime::Hint;
use tracing::warn;

use super::snapshots::Snapshot;
use crate::data::{Source, obtain};

const BATCH_SIZE: usize = 256;
/// Share of the episodes that are held out where no run has done so.
const HELD_OUT: f64 = 0.1;
/// Most states where policies are compared with the data.
pub(super) const COMPARED: usize = 2000;

/// Transitions with standardized observations, actions from −1 to 1, and rewards as recorded.
pub(super) struct Data {
    pub conditions: Conditions,
    pub training: Arc<Transitions>,
    /// The first transition of each judged episode.
    pub first: Batch,
    /// Held-out transitions at whose states policies are compared with the data.
    pub compared: Batch,
    held_out: Transitions,
}

impl Data {
    /// Reads the data of these snapshots, from `dataset` if it is there. They are judged in the
    /// episodes that every run with held-out episodes has held out.
    pub fn read(
        snapshots: &[Snapshot],
        dataset: &[String],
        mut conditions: Conditions,
    ) -> anyhow::Result<Self> {
        let first = snapshots.first().context("there is no policy to judge")?;
        let (run, data) = (first.folder.path().display(), &first.config.dataset);
        let environment = &first.config.experiment.environment;
        for Snapshot { folder, config, .. } in snapshots {
            let (other, theirs) = (folder.path().display(), &config.experiment.environment);
            if config.dataset.sha256() != data.sha256() {
                return Err(anyhow!("{run} and {other} have not learned from the same data"))
                    .hint("judge them apart: values that come from different data do not compare");
            }
            if theirs != environment {
                let both =
                    format!("{run} is of the environment {environment}, {other} of {theirs}");
                return Err(anyhow!(both))
                    .hint("judge them apart: values of different rewards do not compare");
            }
        }
        if dataset.is_empty() && data.files.is_empty() {
            return Err(anyhow!("{run} has learned without a dataset"))
                .hint("name one by --dataset");
        }
        let sources = match dataset {
            [] => data.paths().into_iter().map(Source::Path).collect(),
            names => Source::parse_all(names)?,
        };
        let (paths, hashes) = obtain(&sources).hint(format!(
            "name the data of the run {run} by --dataset; a relative path in the run is below the folder where `learner train` was started"
        ))?;
        let sha256 = hashes.join(", ");
        let recorded = data.sha256().filter(|_| !data.files.is_empty());
        if recorded.is_some_and(|recorded| recorded != sha256) {
            let names = Vec::from_iter(paths.iter().map(|path| path.to_string_lossy())).join(", ");
            return Err(anyhow!("{names} is not the data that {run} has learned from"))
                .hint("name a copy of each of its files by --dataset, in the same order");
        }
        let episodes = shared(snapshots.iter().map(|snapshot| &snapshot.config.dataset.held_out))?;
        if episodes.is_none() {
            warn!(
                "no run has held out episodes (--hold-out), so the policies are judged in some that they have learned from"
            );
        }
        let hold_out = episodes.as_deref().map_or(HoldOut::Fraction(HELD_OUT), HoldOut::Episodes);
        let options = ReadOptions {
            environment: environment::find(environment).ok(),
            task: benchmarks::relabeling(environment),
            reward: RewardRule::AsIs,
            normalize: Normalize { actions: true, observations: true, rewards: false },
            ..ReadOptions::default()
        };
        let split =
            Transitions::read_split(&paths, &options, hold_out).hint_of(DatasetError::hint)?;
        conditions.dataset = sha256;
        conditions.environment = environment.clone();
        Self::new(split, conditions)
    }

    pub fn new(split: Split, conditions: Conditions) -> anyhow::Result<Self> {
        let held_out = split.held_out.context("no episode is left to judge policies in").hint(
            "record more: they are judged in other episodes than those from which values are learned",
        )?;
        let episodes = held_out.recorded_episodes();
        let starts = Vec::from_iter(episodes.iter().map(|episode| episode.start));
        // At even distances.
        let count = held_out.len().min(COMPARED);
        let compared = Vec::from_iter((0..count).map(|i| (i * held_out.len() / count) as u32));
        Ok(Self {
            conditions: Conditions { episodes: split.episodes, ..conditions },
            first: held_out.gather(&starts),
            compared: held_out.gather(&compared),
            training: Arc::new(split.training),
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
    pub fn recorded_value(&self, behavior: &[Fqe]) -> anyhow::Result<f64> {
        let (o, a) = (self.held_out.observation_dim(), self.held_out.action_dim());
        let mut returns = Vec::new();
        for episode in self.held_out.recorded_episodes() {
            let steps = self.held_out.gather(&Vec::from_iter(episode));
            let last = steps.rewards.len() - 1;
            let mut value = f64::from(steps.rewards[last]);
            if steps.masks[last] != 0.0 {
                let (s, a) = (&steps.observations[last * o..], &steps.actions[last * a..]);
                let values = behavior.iter().map(|fqe| Ok(mean_f32(&fqe.values(s, a)?)));
                value = mean(&values.collect::<candle_core::Result<Vec<_>>>()?);
            }
            for reward in steps.rewards[..last].iter().rev() {
                value = f64::from(*reward) + f64::from(self.conditions.gamma) * value;
            }
            returns.push(value);
        }
        Ok(mean(&returns))
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
pub(super) fn shared<'a>(
    held_out: impl Iterator<Item = &'a Vec<usize>>,
) -> anyhow::Result<Option<Vec<usize>>> {
    let held_out = held_out.filter(|episodes| !episodes.is_empty());
    let sets = held_out.map(|episodes| BTreeSet::from_iter(episodes.iter().copied()));
    let Some(shared) = sets.reduce(|a, b| &a & &b) else { return Ok(None) };
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
pub(super) fn distance(data: &[f32], policy: &[f32], action_dim: usize) -> f64 {
    let (mut errors, mut variances) = (Vec::new(), Vec::new());
    for column in 0..action_dim {
        let [data, policy] = [data, policy].map(|actions| {
            let column = actions.iter().skip(column).step_by(action_dim);
            Vec::from_iter(column.map(|action| f64::from(*action)))
        });
        let squares = data.iter().zip(&policy).map(|(x, y)| (x - y).powi(2));
        errors.push(mean(&Vec::from_iter(squares)));
        // By rounding, the variance of equal numbers might not be 0.
        let varies = data.iter().any(|action| *action != data[0]);
        let std = Spread::new(&data).and_then(|spread| spread.population_std);
        variances.push(std.filter(|_| varies).map(|std| std * std));
    }
    let varying = Vec::from_iter(variances.iter().copied().flatten());
    let typical = if varying.is_empty() { 1.0 } else { mean(&varying) };
    let scaled = |(error, variance): (f64, Option<f64>)| error / variance.unwrap_or(typical);
    mean(&Vec::from_iter(errors.into_iter().zip(variances).map(scaled))).sqrt()
}

pub(super) fn mean_f32(values: &[f32]) -> f64 {
    mean(&Vec::from_iter(values.iter().map(|value| f64::from(*value))))
}
