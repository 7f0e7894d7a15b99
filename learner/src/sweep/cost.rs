//! Estimates the cost of a study from one second of training of each of its configurations.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::Duration;

use indicatif::{HumanBytes, HumanDuration};
use quad_run::config::{Device, settings};
use quad_run::counted;
use quad_run::results::Spread;
use quad_run::status::State;
use rayon::ThreadPoolBuilder;
use tracing::warn;

use super::study::PlannedRun;
use crate::data::load;
use crate::train::RunCost;

/// Further configurations are assumed to cost as much as the mean of these.
const MAX_MEASURED: usize = 20;

#[derive(Default)]
pub(crate) struct StudyCost {
    /// Seconds of a gradient step, by the run's index.
    pub step_seconds: BTreeMap<usize, f64>,
    /// Remaining training time of all runs together.
    seconds: f64,
    /// Final disk space of all runs together.
    bytes: f64,
    measured: usize,
}

impl StudyCost {
    /// Measures the runs whose dataset is on this machine. A run that cannot start costs nothing;
    /// its learner will report the error.
    pub fn measure<'a>(
        runs: &[(PlannedRun, State)],
        dataset: impl Fn(&PlannedRun) -> Option<&'a [PathBuf]>,
    ) -> anyhow::Result<Self> {
        let one_thread = ThreadPoolBuilder::new().num_threads(1).build()?;
        let mut told = BTreeSet::new();
        let mut measure = |run: &PlannedRun, paths: &[PathBuf]| {
            let data = load(paths, &run.experiment, None)?;
            for warning in data.training.warnings() {
                if told.insert(warning.clone()) {
                    warn!("{warning}");
                }
            }
            let cost =
                one_thread.install(|| RunCost::measure(&run.experiment, Device::Cpu, data))?;
            anyhow::Ok((cost.step_seconds, cost.bytes(&run.experiment) as f64))
        };
        // Seconds of a step and bytes of a run.
        let mut costs: BTreeMap<String, (f64, f64)> = BTreeMap::new();
        for (run, _) in runs {
            let key = configuration(run);
            if costs.len() == MAX_MEASURED || costs.contains_key(&key) {
                continue;
            }
            let cost = dataset(run).map(|paths| measure(run, paths)).transpose();
            let cost = cost.unwrap_or_else(|error| {
                warn!("the run {} cannot begin: {error:#}", run.name);
                None
            });
            costs.insert(key, cost.unwrap_or_default());
        }
        let (seconds, bytes): (Vec<_>, Vec<_>) =
            costs.values().filter(|(seconds, _)| *seconds > 0.0).copied().unzip();
        let mean = |values: &[f64]| Spread::new(values).map_or(0.0, |spread| spread.mean);
        let typical = (mean(&seconds), mean(&bytes));
        let mut study = Self { measured: seconds.len(), ..Self::default() };
        for (run, state) in runs {
            let (seconds, bytes) = costs.get(&configuration(run)).copied().unwrap_or(typical);
            let steps = run.experiment.total_steps();
            study.step_seconds.insert(run.index, seconds);
            study.seconds += seconds * (steps - state.step(steps).min(steps)) as f64;
            study.bytes += bytes;
        }
        Ok(study)
    }

    /// The cost in words, with this many runs at a time.
    pub fn text(&self, jobs: usize) -> String {
        let left = HumanDuration(Duration::from_secs_f64((self.seconds / jobs as f64).ceil()));
        let (measured, bytes) =
            (counted(self.measured, "configuration"), HumanBytes(self.bytes as u64));
        format!(
            "training takes about {left}, {jobs} at a time (by a second's measurement of {measured}, each alone on one \
             thread); these runs take {bytes} of disk"
        )
    }
}

/// Key of runs that cost the same: all settings but the seed.
fn configuration(run: &PlannedRun) -> String {
    let mut settings = settings::from_experiment(&run.experiment);
    settings.remove("seed");
    format!("{settings:?} {:?}", run.sources)
}
