//! Estimates of values by fitted Q evaluation, and reasons to doubt them.

use std::num::NonZero;
use std::thread;

use anyhow::anyhow;
use quad_algorithms::{Columns, Examples, Fqe, FqeConfig, Units};
use quad_run::results::Estimate;
use quad_run::results::statistics::mean;
use rayon::ThreadPoolBuilder;

use super::actions::Actions;
use super::data::{Data, mean_f32};

/// Points of a learning curve. The estimate is the mean of the last [`LAST`].
pub(super) const POINTS: usize = 20;
pub(super) const LAST: usize = 4;
/// Largest change of a converged estimate, in standard deviations of the data's returns.
const CONVERGED: f64 = 0.1;
/// Largest growth of the loss at the end.
const GROWTH: f64 = 2.0;
/// Tolerance of an estimate's bounds, relative to their distance.
const TOLERANCE: f64 = 0.02;

pub(super) struct Evaluation<'a> {
    data: &'a Data,
    config: FqeConfig,
    pub units: Units,
}

#[derive(Default)]
pub(super) struct LearningCurve {
    /// Mean value of the judged episodes' first states.
    pub values: Vec<f64>,
    /// Mean loss since the point before.
    pub losses: Vec<f64>,
}

/// Evaluations of one policy, one for each seed.
type Evaluations = (Vec<Fqe>, Vec<LearningCurve>);

impl<'a> Evaluation<'a> {
    pub fn new(data: &'a Data) -> anyhow::Result<Self> {
        let gamma = data.conditions.gamma;
        let units = Units::new(&data.training, gamma.into());
        Ok(Self { data, config: FqeConfig::with_discount(gamma)?, units })
    }

    /// Evaluates the policy that recorded the data.
    pub fn behavior(&self) -> anyhow::Result<Evaluations> {
        self.for_each_seed(|seed| {
            let fqe = Fqe::new(self.config.clone(), self.units, self.data.context(seed))?;
            let examples = self.data.examples(Columns::NextActions)?;
            self.train(fqe, &examples, seed, &self.data.first.actions)
        })
    }

    /// Evaluates the policy of these actions, from the behavior policy's networks on.
    pub fn policy(&self, actions: &Actions, behavior: &[Fqe]) -> anyhow::Result<Evaluations> {
        self.for_each_seed(|seed| {
            let (config, context) = (self.config.clone(), self.data.context(seed));
            let mut fqe = Fqe::new(config, self.units, context)?;
            fqe.begin_with(&behavior[seed as usize])?;
            let examples = self.data.examples(Columns::Plain)?;
            let examples = examples.with_next_actions(actions.next.clone());
            self.train(fqe, &examples, seed, &actions.first)
        })
    }

    /// `first`: actions in the judged episodes' first states.
    fn train(
        &self,
        mut fqe: Fqe,
        examples: &Examples,
        seed: u64,
        first: &[f32],
    ) -> anyhow::Result<(Fqe, LearningCurve)> {
        let mut sampler = self.data.sampler(examples, seed);
        let mut curve = LearningCurve::default();
        let begin = |point: usize| self.data.conditions.steps * point as u64 / POINTS as u64;
        for point in 0..POINTS {
            let mut losses = Vec::new();
            for step in begin(point)..begin(point + 1) {
                let metrics = fqe.update(step, &examples.batch(sampler.next_indices())?)?;
                let loss = metrics.iter().find(|(name, _)| *name == "critic_loss");
                losses.extend(loss.map(|(_, loss)| *loss));
            }
            curve.losses.push(mean_f32(&losses));
            let values = fqe.values(&self.data.first.observations, first)?;
            curve.values.push(mean_f32(&values));
        }
        Ok((fqe, curve))
    }

    /// Trains all seeds in parallel, each on its share of the cores: updates this small gain little
    /// by more.
    fn for_each_seed(
        &self,
        train: impl Fn(u64) -> anyhow::Result<(Fqe, LearningCurve)> + Sync,
    ) -> anyhow::Result<Evaluations> {
        let seeds = self.data.conditions.seeds;
        let cores = thread::available_parallelism().map_or(1, NonZero::get);
        let (share, train) = ((cores / seeds as usize).max(1), &train);
        thread::scope(|scope| {
            let mut threads = Vec::new();
            for seed in 0..seeds {
                let pool = ThreadPoolBuilder::new().num_threads(share).build()?;
                threads.push(scope.spawn(move || pool.install(|| train(seed))));
            }
            let ended = threads.into_iter().map(|thread| {
                thread.join().map_err(|_| anyhow!("an evaluation panicked")).flatten()
            });
            ended.collect()
        })
    }
}

/// The estimate from one learning curve per seed.
pub(super) fn estimate(curves: &[LearningCurve], units: &Units) -> Estimate {
    let (mut estimates, mut doubts) = (Vec::new(), Vec::new());
    let tolerance = TOLERANCE * (units.most - units.least);
    let bounds = units.least - tolerance..=units.most + tolerance;
    for (seed, curve) in curves.iter().enumerate() {
        let end = |points: &[f64]| {
            let (before, last) = points[POINTS - 2 * LAST..].split_at(LAST);
            [before, last].map(mean)
        };
        let ([before, value], [loss_before, loss]) = (end(&curve.values), end(&curve.losses));
        let mut doubt = |text: String| doubts.push(format!("seed {seed}: {text}"));
        if !bounds.contains(&value) {
            doubt(format!("{value:.2} is beyond what rewards allow"));
        } else if (value - before).abs() > CONVERGED * units.scale {
            doubt(format!("still moves, from {before:.2} to {value:.2}"));
        }
        if loss > GROWTH * loss_before {
            doubt(format!("the loss grows, from {loss_before:.3} to {loss:.3}"));
        }
        estimates.push(value);
    }
    Estimate { values: estimates, doubts }
}
