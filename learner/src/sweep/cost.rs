//! Estimates a study's cost from one second of training of each of its configurations.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use indicatif::{HumanBytes, HumanDuration};
use quad_run::config::{Device, settings};
use quad_run::status::State;
use tracing::warn;

use super::study::PlannedRun;
use crate::data::load;
use crate::train::Price;

/// Most configurations that are; further ones are taken to cost as much as these on average.
const MOST_MEASURED: usize = 20;

/// What runs will cost.
pub(crate) struct Cost {
    /// Seconds of a gradient step, by the run's number.
    pub step_seconds: BTreeMap<usize, f64>,
    /// Seconds of training that is left, in all runs together.
    seconds: f64,
    /// Disk space at the end, of all runs together, bytes.
    bytes: u64,
    /// Configurations that were measured.
    measured: usize,
}

impl Cost {
    /// Measures these runs, of which so much is done, from data that is on this machine. A run that
    /// cannot begin takes nothing, which is said; its learner will say it again.
    ///
    /// # Errors
    /// No thread can be started.
    pub fn measure<'a>(
        runs: &[(PlannedRun, State)],
        dataset: impl Fn(&PlannedRun) -> Option<&'a Path>,
    ) -> anyhow::Result<Self> {
        let mut prices: BTreeMap<String, Price> = BTreeMap::new();
        let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
        for (run, _) in runs {
            let key = configuration(run);
            if prices.len() < MOST_MEASURED && !prices.contains_key(&key) {
                let price = dataset(run).map(|dataset| {
                    let transitions = load(dataset, &run.experiment)?.training;
                    one_thread.install(|| Price::measure(&run.experiment, Device::Cpu, transitions))
                });
                let refused = |error| warn!("the run {} cannot begin: {error:#}", run.name);
                prices.insert(
                    key,
                    price.and_then(|price| price.map_err(refused).ok()).unwrap_or_default(),
                );
            }
        }
        let measured = prices.values().filter(|price| price.step_seconds > 0.0).count();
        let mean = |value: fn(&Price) -> f64| {
            prices.values().map(value).sum::<f64>() / measured.max(1) as f64
        };
        let other = Price {
            step_seconds: mean(|price| price.step_seconds),
            snapshot_bytes: mean(|price| price.snapshot_bytes as f64) as u64,
            checkpoint_bytes: mean(|price| price.checkpoint_bytes as f64) as u64,
        };
        let mut cost = Self { step_seconds: BTreeMap::new(), seconds: 0.0, bytes: 0, measured };
        for (run, state) in runs {
            let price = prices.get(&configuration(run)).copied().unwrap_or(other);
            let steps = run.experiment.steps;
            cost.step_seconds.insert(run.index, price.step_seconds);
            cost.seconds += price.step_seconds * (steps - state.step(steps).min(steps)) as f64;
            cost.bytes += price.bytes(&run.experiment);
        }
        Ok(cost)
    }

    /// Says the cost in words, for this many runs at a time.
    pub fn text(&self, jobs: usize) -> String {
        let left = HumanDuration(Duration::from_secs_f64(self.seconds / jobs as f64));
        format!(
            "training takes about {left}, {jobs} at a time (by a second's measurement of {} configurations, each alone on one \
             thread); these runs take {} of disk",
            self.measured,
            HumanBytes(self.bytes)
        )
    }
}

/// What runs of the same price share: everything but the seed.
fn configuration(run: &PlannedRun) -> String {
    let mut settings = settings::of_experiment(&run.experiment);
    settings.remove("seed");
    format!("{settings:?} {:?}", run.source)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::super::Study;
    use super::*;

    #[test]
    fn seeds_cost_the_same() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.toml");
        let text = "about = 'x'\nrun = { task = 'hopper-demo', dataset = 'x.hdf5' }\n\
                    axes = { seed = [0, 1], batch_size = [8, 16] }";
        std::fs::write(&path, text).unwrap();
        let runs = Study::read(&path, &[], &[]).unwrap().runs;
        let [one, other, again, _] = [0, 1, 2, 3].map(|index| configuration(&runs[index]));
        assert!(one == again && one != other, "{one}");
    }
}
