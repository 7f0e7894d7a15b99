//! What training gives.

use quad_algorithms::Metric;
use serde::ser::SerializeMap;
use serde::{Serialize, Serializer};

use super::held_out;

/// The policy after a gradient step.
#[derive(Debug)]
pub(crate) struct TrainedPolicy {
    /// After which step.
    pub step: u64,
    /// Its file.
    pub file: Vec<u8>,
    /// Whether it is to be evaluated, or only kept.
    pub evaluate: bool,
}

/// A line of `metrics.jsonl`: means over the gradient steps since the line before.
#[derive(Clone, Debug)]
pub(crate) struct Row {
    /// Gradient steps done.
    pub step: u64,
    /// Since training began.
    pub seconds: f64,
    /// What was measured.
    pub metrics: &'static [Metric],
    /// The means, in the order of `metrics`; none of what none of the steps measured.
    pub values: Vec<Option<f32>>,
    /// What was measured on held-out episodes after the last of the steps, in that order; empty if
    /// nothing was.
    pub held_out: Vec<Option<f32>>,
}

impl Serialize for Row {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("step", &self.step)?;
        map.serialize_entry("seconds", &self.seconds)?;
        for (metric, value) in measured(self.metrics, &self.values) {
            map.serialize_entry(metric.name, &value)?;
        }
        for (metric, value) in measured(self.metrics, &self.held_out) {
            map.serialize_entry(&held_out::name(metric), &value)?;
        }
        map.end()
    }
}

/// The metrics that have a value, with it.
pub(super) fn measured<'a>(
    metrics: &'a [Metric],
    values: &'a [Option<f32>],
) -> impl Iterator<Item = (&'a Metric, f32)> {
    metrics.iter().zip(values).filter_map(|(metric, value)| Some((metric, (*value)?)))
}

/// Means of metrics, each over the times that it was measured. Sums in f64.
pub(super) struct Means(Vec<(f64, u32)>);

impl Means {
    /// Of so many metrics.
    pub fn new(count: usize) -> Self {
        Self(vec![(0.0, 0); count])
    }

    /// Takes in values in the order of the metrics, as far as they were measured.
    pub fn add(&mut self, values: &[Option<f32>]) {
        for ((sum, count), value) in
            self.0.iter_mut().zip(values).filter_map(|(mean, value)| Some((mean, (*value)?)))
        {
            *sum += f64::from(value);
            *count += 1;
        }
    }

    /// The means so far; begins anew.
    pub fn take(&mut self) -> Vec<Option<f32>> {
        let means = std::mem::replace(self, Self::new(self.0.len()));
        means
            .0
            .into_iter()
            .map(|(sum, count)| (count > 0).then(|| (sum / f64::from(count)) as f32))
            .collect()
    }
}

/// How training ended well.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// All steps are done.
    Completed,
    /// It was stopped after this many.
    Stopped {
        /// Gradient steps done.
        step: u64,
    },
}
