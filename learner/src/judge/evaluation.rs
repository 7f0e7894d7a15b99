//! The estimate of a policy's value, and what makes it doubtful.

use std::num::NonZero;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::anyhow;
use quad_algorithms::{AlgorithmError, Fqe, FqeConfig, Units};
use quad_dataset::BatchSampler;
use quad_run::results::Estimate;
use quad_runtime::Hint;

use super::Effort;
use super::acting::Actions;
use super::data::{Data, mean};

/// How often an evaluation notes where it is. Its result is the mean of the last [`LAST`] notes.
const NOTES: usize = 20;
const LAST: usize = 4;
/// Updates by which the time of the others is foretold.
const TIMED: u64 = 50;
/// How far an estimate may still move, in standard deviations of the data's returns.
const SETTLED: f64 = 0.1;
/// How much larger than before the loss may be at the end.
const GROWN: f64 = 2.0;
/// How far beyond what rewards allow an estimate may be, relative to the range that they allow.
const BEYOND: f64 = 0.02;

/// How values are estimated.
pub(super) struct Evaluation<'a> {
    pub config: FqeConfig,
    pub units: Units,
    pub data: &'a Data,
    pub effort: Effort,
}

/// Where an evaluation was, note by note.
pub(super) struct Trace {
    /// Mean value of the judged episodes' first states.
    values: Vec<f64>,
    /// Mean loss since the note before.
    losses: Vec<f64>,
}

impl Evaluation<'_> {
    /// Evaluates the behavior that recorded the data, once for each seed.
    ///
    /// # Errors
    /// The data does not say what it did, or candle fails.
    pub fn of_behavior(&self) -> anyhow::Result<Vec<(Fqe, Trace)>> {
        self.for_each_seed(|seed| {
            let mut fqe = self.behavior(seed)?;
            let trace = self.train(&mut fqe, seed, &self.data.first.actions)?;
            Ok((fqe, trace))
        })
    }

    /// Evaluates a policy, once for each seed, beginning with what is known of the behavior.
    ///
    /// # Errors
    /// Candle fails.
    pub fn of_policy(&self, actions: &Actions, behavior: &[&Fqe]) -> anyhow::Result<Vec<Trace>> {
        self.for_each_seed(|seed| {
            let context = self.data.context(seed);
            let mut fqe = Fqe::new(self.config.clone(), self.units, context, actions.next.clone())?;
            fqe.begin_with(behavior[seed as usize])?;
            self.train(&mut fqe, seed, &actions.first)
        })
    }

    /// How long an evaluation takes with all its seeds, by a few updates.
    ///
    /// # Errors
    /// Those of [`Self::of_behavior`].
    pub fn time(&self) -> anyhow::Result<Duration> {
        let times = self.for_each_seed(|seed| {
            let mut fqe = self.behavior(seed)?;
            // The first ones also fetch memory.
            let mut sampler = self.sampler(&fqe, seed);
            updates(&mut fqe, &mut sampler, 0..TIMED)?;
            let begin = Instant::now();
            updates(&mut fqe, &mut sampler, TIMED..2 * TIMED)?;
            Ok(begin.elapsed().mul_f64(self.effort.steps as f64 / TIMED as f64))
        })?;
        Ok(times.into_iter().max().unwrap_or_default())
    }

    fn behavior(&self, seed: u64) -> anyhow::Result<Fqe> {
        let context = self.data.context(seed);
        Fqe::of_behavior(self.config.clone(), self.units, context).hint_of(AlgorithmError::hint)
    }

    /// Trains to the end. `first` are the actions in the judged episodes' first states.
    fn train(&self, fqe: &mut Fqe, seed: u64, first: &[f32]) -> anyhow::Result<Trace> {
        let (mut trace, mut sampler) =
            (Trace { values: Vec::new(), losses: Vec::new() }, self.sampler(fqe, seed));
        let at = |note: usize| self.effort.steps * note as u64 / NOTES as u64;
        for note in 0..NOTES {
            trace.losses.push(updates(fqe, &mut sampler, at(note)..at(note + 1))?);
            trace.values.push(mean(fqe.values(&self.data.first.observations, first)?.into_iter()));
        }
        Ok(trace)
    }

    /// The batches of an evaluation, from its beginning.
    fn sampler(&self, fqe: &Fqe, seed: u64) -> BatchSampler {
        BatchSampler::new(fqe.items(), self.data.context(seed).batch_size, seed, 0)
    }

    /// Does the work of all seeds at the same time. Each has its share of the cores: updates this
    /// small gain little by more.
    fn for_each_seed<T: Send>(
        &self,
        work: impl Fn(u64) -> anyhow::Result<T> + Sync,
    ) -> anyhow::Result<Vec<T>> {
        let seeds = self.effort.seeds;
        let cores = thread::available_parallelism().map_or(1, NonZero::get);
        let pool =
            || rayon::ThreadPoolBuilder::new().num_threads((cores / seeds as usize).max(1)).build();
        let pools = (0..seeds).map(|_| pool()).collect::<Result<Vec<_>, _>>()?;
        thread::scope(|scope| {
            let work = &work;
            let started = pools
                .iter()
                .zip(0..)
                .map(|(pool, seed)| scope.spawn(move || pool.install(|| work(seed))));
            let started: Vec<_> = started.collect();
            started
                .into_iter()
                .map(|thread| thread.join().map_err(|_| anyhow!("an evaluation panicked"))?)
                .collect()
        })
    }
}

/// Does these updates, and gives their mean loss.
fn updates(
    fqe: &mut Fqe,
    sampler: &mut BatchSampler,
    steps: std::ops::Range<u64>,
) -> anyhow::Result<f64> {
    let (mut sum, count) = (0.0, steps.end - steps.start);
    for step in steps {
        let measured = fqe.update(step, sampler.next_items())?;
        sum += measured
            .iter()
            .find(|(name, _)| *name == "critic_loss")
            .map_or(0.0, |(_, loss)| f64::from(*loss));
    }
    Ok(sum / count as f64)
}

/// What the evaluations of one policy say of its value.
pub(super) fn estimate<'a>(traces: impl IntoIterator<Item = &'a Trace>, units: &Units) -> Estimate {
    let mut estimate = Estimate { values: Vec::new(), doubts: Vec::new() };
    for (trace, seed) in traces.into_iter().zip(0..) {
        let [(value, loss), (value_before, loss_before)] = [1, 2].map(|back| {
            let part = NOTES - back * LAST..NOTES - (back - 1) * LAST;
            (
                mean(trace.values[part.clone()].iter().copied()),
                mean(trace.losses[part].iter().copied()),
            )
        });
        let beyond = BEYOND * (units.most - units.least);
        let (least, most) = (units.least - beyond, units.most + beyond);
        let mut doubt = |text: String| estimate.doubts.push(format!("seed {seed}: {text}"));
        if !(least..=most).contains(&value) {
            doubt(format!("{value:.2} is beyond what rewards allow"));
        } else if (value - value_before).abs() > SETTLED * units.scale {
            doubt(format!("still moves, from {value_before:.2} to {value:.2}"));
        }
        if loss > GROWN * loss_before {
            doubt(format!("the loss grows, from {loss_before:.3} to {loss:.3}"));
        }
        estimate.values.push(value);
    }
    estimate
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    const UNITS: Units = Units { offset: 0.0, scale: 10.0, least: 0.0, most: 100.0 };

    /// The estimate of an evaluation whose last notes have one value and loss, and those before
    /// them another.
    fn estimated(values: [f64; 2], losses: [f64; 2]) -> Estimate {
        let notes =
            |[before, last]: [f64; 2]| [vec![before; NOTES - LAST], vec![last; LAST]].concat();
        estimate([&Trace { values: notes(values), losses: notes(losses) }], &UNITS)
    }

    #[test]
    fn an_estimate_is_where_it_ends_and_doubtful_where_it_is_not_settled() {
        let settled = estimated([50.5, 50.0], [1.0, 1.5]);
        assert_eq!((settled.values, settled.doubts), (vec![50.0], vec![]));
        for (values, losses, doubt) in [
            ([50.0, 52.0], [1.0; 2], "still moves, from 50.00 to 52.00"),
            ([52.0, 50.0], [1.0; 2], "still moves, from 52.00 to 50.00"),
            ([50.0; 2], [1.0, 3.0], "the loss grows, from 1.000 to 3.000"),
            ([-3.0; 2], [1.0; 2], "-3.00 is beyond what rewards allow"),
            ([103.0; 2], [1.0; 2], "103.00 is beyond what rewards allow"),
        ] {
            let found = estimated(values, losses);
            assert_eq!(
                (found.values, found.doubts),
                (vec![values[1]], vec![format!("seed 0: {doubt}")])
            );
        }
    }
}
