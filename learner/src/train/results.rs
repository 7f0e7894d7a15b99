//! Output of training.

use quad_algorithms::Metric;
use serde::ser::SerializeMap;
use serde::{Serialize, Serializer};

/// Gradient steps that a line of `metrics.jsonl` averages over.
pub(super) const STEPS_PER_ROW: u64 = 100;

/// The policy after a gradient step.
#[derive(Debug)]
pub(crate) struct TrainedPolicy {
    pub step: u64,
    pub file: Vec<u8>,
    /// True if it is evaluated.
    pub evaluate: bool,
    /// True if online episodes are played with it. A policy with neither, the last of a run, is only kept.
    pub online: bool,
}

/// A line of `metrics.jsonl`: means over the gradient steps since the line before.
#[derive(Clone, Debug)]
pub(crate) struct Row {
    pub step: u64,
    /// Time since training began.
    pub seconds: f64,
    pub metrics: &'static [Metric],
    /// Means in the order of `metrics`; `None` if none of the steps measured it.
    pub values: Vec<Option<f32>>,
    /// Values on held-out episodes after the last of the steps, in the order of `metrics`; empty if
    /// nothing was measured.
    pub held_out: Vec<Option<f32>>,
    /// Experience so far; empty before online learning.
    pub online: Vec<(&'static str, f64)>,
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
            map.serialize_entry(&held_out_name(metric), &value)?;
        }
        for (name, value) in &self.online {
            map.serialize_entry(name, value)?;
        }
        map.end()
    }
}

/// The name of a metric on held-out episodes.
pub(crate) fn held_out_name(metric: &Metric) -> String {
    format!("held_out_{}", metric.name)
}

/// The metrics that have a value.
pub(super) fn measured<'a>(
    metrics: &'a [Metric],
    values: &'a [Option<f32>],
) -> impl Iterator<Item = (&'a Metric, f32)> {
    metrics.iter().zip(values).filter_map(|(metric, value)| Some((metric, (*value)?)))
}

/// Running means of metrics: sum and count of each.
pub(super) struct Means(Vec<(f64, u32)>);

impl Means {
    /// Means of this many metrics.
    pub fn new(count: usize) -> Self {
        Self(vec![(0.0, 0); count])
    }

    /// Adds values in the order of the metrics.
    pub fn add(&mut self, values: &[Option<f32>]) {
        for ((sum, count), value) in self.0.iter_mut().zip(values) {
            if let Some(value) = value {
                *sum += f64::from(*value);
                *count += 1;
            }
        }
    }

    /// Returns the means and resets them.
    pub fn take(&mut self) -> Vec<Option<f32>> {
        let mean = |(sum, count): &mut (f64, u32)| {
            let mean = (*count > 0).then(|| (*sum / f64::from(*count)) as f32);
            (*sum, *count) = (0.0, 0);
            mean
        };
        self.0.iter_mut().map(mean).collect()
    }
}

/// The end of training without an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Outcome {
    Completed,
    Stopped,
}
