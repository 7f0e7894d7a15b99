//! Estimates of values by fitted Q evaluation, and reasons to doubt them.

use std::num::NonZero;
use std::ops::Range;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::anyhow;
use quad_algorithms::{Columns, Examples, Fqe, FqeConfig, Units};
use quad_dataset::BatchSampler;
use quad_run::results::Estimate;
use rayon::ThreadPoolBuilder;

use super::actions::Actions;
use super::data::{Data, mean};

/// Points of a learning curve. The estimate is the mean of the last [`LAST`].
const POINTS: usize = 20;
const LAST: usize = 4;
/// Updates that are timed to forecast all of them.
const TIMED: u64 = 50;
/// Largest change of a converged estimate, in standard deviations of the data's returns.
const CONVERGED: f64 = 0.1;
/// Largest growth of the loss at the end.
const GROWTH: f64 = 2.0;
/// Tolerance of an estimate's bounds, relative to their distance.
const TOLERANCE: f64 = 0.02;

#[derive(Clone, Copy, Debug)]
pub(crate) struct Budget {
    /// Gradient steps of an evaluation.
    pub steps: u64,
    /// Evaluations of each policy.
    pub seeds: u64,
}

pub(super) struct Evaluation<'a> {
    pub config: FqeConfig,
    pub units: Units,
    pub data: &'a Data,
    pub budget: Budget,
}

#[derive(Default)]
pub(super) struct LearningCurve {
    /// Mean value of the judged episodes' first states.
    values: Vec<f64>,
    /// Mean loss since the point before.
    losses: Vec<f64>,
}

impl Evaluation<'_> {
    /// Evaluates the behavior policy, once for each seed.
    pub fn of_behavior(&self) -> anyhow::Result<Vec<(Fqe, LearningCurve)>> {
        self.for_each_seed(|seed| {
            let (mut fqe, examples) = self.behavior(seed)?;
            let curve = self.train(&mut fqe, &examples, seed, &self.data.first.actions)?;
            Ok((fqe, curve))
        })
    }

    /// Evaluates a policy, once for each seed, starting from the behavior policy's networks.
    pub fn of_policy(
        &self,
        actions: &Actions,
        behavior: &[Fqe],
    ) -> anyhow::Result<Vec<LearningCurve>> {
        self.for_each_seed(|seed| {
            let (config, context) = (self.config.clone(), self.data.context(seed));
            let mut fqe = Fqe::new(config, self.units, context)?;
            fqe.begin_with(&behavior[seed as usize])?;
            let examples = self.data.examples(Columns::Plain)?;
            let examples = examples.with_next_actions(actions.next.clone());
            self.train(&mut fqe, &examples, seed, &actions.first)
        })
    }

    /// Estimates how long an evaluation with all its seeds takes.
    pub fn time(&self) -> anyhow::Result<Duration> {
        let times = self.for_each_seed(|seed| {
            let (mut fqe, examples) = self.behavior(seed)?;
            let mut sampler = self.data.sampler(&examples, seed);
            // Warm-up: the first updates also allocate memory.
            updates(&mut fqe, &examples, &mut sampler, 0..TIMED)?;
            let begin = Instant::now();
            updates(&mut fqe, &examples, &mut sampler, TIMED..2 * TIMED)?;
            let times = self.budget.steps as f64 / TIMED as f64;
            Ok(begin.elapsed().mul_f64(times))
        })?;
        Ok(times.into_iter().max().unwrap_or_default())
    }

    /// An evaluation of the behavior policy at step 0, and the transitions whose next action is in the
    /// data.
    fn behavior(&self, seed: u64) -> anyhow::Result<(Fqe, Examples)> {
        let fqe = Fqe::new(self.config.clone(), self.units, self.data.context(seed))?;
        Ok((fqe, self.data.examples(Columns::NextActions)?))
    }

    /// `first`: actions in the judged episodes' first states.
    fn train(
        &self,
        fqe: &mut Fqe,
        examples: &Examples,
        seed: u64,
        first: &[f32],
    ) -> anyhow::Result<LearningCurve> {
        let mut curve = LearningCurve::default();
        let mut sampler = self.data.sampler(examples, seed);
        let step = |point: usize| self.budget.steps * point as u64 / POINTS as u64;
        for point in 0..POINTS {
            let loss = updates(fqe, examples, &mut sampler, step(point)..step(point + 1))?;
            let values = fqe.values(&self.data.first.observations, first)?;
            curve.losses.push(loss);
            curve.values.push(mean(values));
        }
        Ok(curve)
    }

    /// Runs all seeds in parallel, each on its share of the cores: updates this small gain little
    /// by more.
    fn for_each_seed<T: Send>(
        &self,
        work: impl Fn(u64) -> anyhow::Result<T> + Sync,
    ) -> anyhow::Result<Vec<T>> {
        let cores = thread::available_parallelism().map_or(1, NonZero::get);
        let share = (cores / self.budget.seeds as usize).max(1);
        let work = &work;
        thread::scope(|scope| {
            let mut threads = Vec::new();
            for seed in 0..self.budget.seeds {
                let pool = ThreadPoolBuilder::new().num_threads(share).build()?;
                threads.push(scope.spawn(move || pool.install(|| work(seed))));
            }
            let join = |thread: thread::ScopedJoinHandle<anyhow::Result<T>>| {
                let result = thread.join();
                result.map_err(|_| anyhow!("an evaluation panicked"))?
            };
            threads.into_iter().map(join).collect()
        })
    }
}

/// Mean loss of these updates.
fn updates(
    fqe: &mut Fqe,
    examples: &Examples,
    sampler: &mut BatchSampler,
    steps: Range<u64>,
) -> anyhow::Result<f64> {
    let mut losses = Vec::new();
    for step in steps {
        let metrics = fqe.update(step, &examples.batch(sampler.next_indices())?)?;
        let loss = metrics.iter().find(|(name, _)| *name == "critic_loss");
        losses.extend(loss.map(|(_, loss)| *loss));
    }
    Ok(mean(losses))
}

/// The estimate from one learning curve per seed.
pub(super) fn estimate(curves: &[LearningCurve], units: &Units) -> Estimate {
    let (mut estimates, mut doubts) = (Vec::new(), Vec::new());
    let tolerance = TOLERANCE * (units.most - units.least);
    let bounds = units.least - tolerance..=units.most + tolerance;
    for (seed, LearningCurve { values, losses }) in curves.iter().enumerate() {
        let last = |points: &[f64]| mean(points[POINTS - LAST..].iter().copied());
        let before =
            |points: &[f64]| mean(points[POINTS - 2 * LAST..POINTS - LAST].iter().copied());
        let (value, value_before) = (last(values), before(values));
        let (loss, loss_before) = (last(losses), before(losses));
        let mut doubt = |text: String| doubts.push(format!("seed {seed}: {text}"));
        if !bounds.contains(&value) {
            doubt(format!("{value:.2} is beyond what rewards allow"));
        } else if (value - value_before).abs() > CONVERGED * units.scale {
            doubt(format!("still moves, from {value_before:.2} to {value:.2}"));
        }
        if loss > GROWTH * loss_before {
            let growth = format!("from {loss_before:.3} to {loss:.3}");
            doubt(format!("the loss grows, {growth}"));
        }
        estimates.push(value);
    }
    Estimate { values: estimates, doubts }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use quad_dataset::{Arrays, Split, Transitions};

    use super::*;

    /// Episodes of two steps, whose states are 0 and 1 and whose rewards are their actions, which are
    /// 0 on average.
    fn rewarding(episodes: usize) -> Transitions {
        let rows = 2 * episodes;
        let actions = Vec::from_iter((0..rows).map(|row| (row as f32 * 2.4).sin()));
        Transitions::of(Arrays {
            observation_dim: 1,
            action_dim: 1,
            observations: [0.0, 1.0].repeat(episodes),
            rewards: actions.clone(),
            actions,
            next_observations: [1.0, 2.0].repeat(episodes),
            terminals: [false, true].repeat(episodes),
            timeouts: vec![false; rows],
        })
        .unwrap()
    }

    /// It acts by 0.8 in the first state and by -0.4 in the second, so its value is 0.8 - 0.4 γ.
    #[test]
    fn a_policy_has_its_own_value_not_the_behaviors() {
        let (training, held_out) = (rewarding(24), Some(rewarding(8)));
        let split = Split { training, held_out, episodes: Vec::from_iter(0..8) };
        let data = Data::of(split, String::new(), String::new()).unwrap();
        let config = FqeConfig::with_discount(0.5).unwrap();
        let units = Units::new(&data.training, 0.5);
        let budget = Budget { steps: 200, seeds: 1 };
        let evaluation = Evaluation { config, units, data: &data, budget };
        let (behavior, curves): (Vec<_>, Vec<_>) =
            evaluation.of_behavior().unwrap().into_iter().unzip();
        let value = |curves: &[LearningCurve]| estimate(curves, &units).values[0];
        assert!(value(&curves).abs() < 0.2, "{} of the behavior", value(&curves));
        let act = |states: &[f32]| Vec::from_iter(states.iter().map(|state| 0.8 - 1.2 * state));
        let training = data.training.gather(&Vec::from_iter(0..48));
        let actions = Actions {
            next: act(&training.next_observations),
            first: act(&data.first.observations),
            compared: act(&data.compared.observations),
        };
        let policy = value(&evaluation.of_policy(&actions, &behavior).unwrap());
        assert!((policy - 0.6).abs() < 0.2, "{policy} of the policy");
    }

    #[test]
    fn estimates_that_have_not_converged_are_doubted() {
        let units = Units { offset: 0.0, scale: 10.0, least: 0.0, most: 100.0 };
        for (values, losses, doubt) in [
            ([50.5, 50.0], [1.0, 1.5], ""),
            ([50.0, 52.0], [1.0; 2], "still moves, from 50.00 to 52"),
            ([52.0, 50.0], [1.0; 2], "still moves, from 52.00 to 50"),
            ([50.0; 2], [1.0, 3.0], "grows, from 1.000 to 3.000"),
            ([-3.0; 2], [1.0; 2], "-3.00 is beyond"),
            ([103.0; 2], [1.0; 2], "103.00 is beyond"),
        ] {
            let points =
                |[before, last]: [f64; 2]| [vec![before; POINTS - LAST], vec![last; LAST]].concat();
            let expected = values[1];
            let [values, losses] = [values, losses].map(points);
            let found = estimate(&[LearningCurve { values, losses }], &units);
            assert_eq!(found.values, [expected]);
            assert_eq!(found.doubts.is_empty(), doubt.is_empty());
            assert!(found.doubts.concat().contains(doubt), "{doubt}");
        }
    }
}
