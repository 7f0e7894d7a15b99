//! What training gives.

use quad_algorithms::Metric;
use serde::ser::SerializeMap;
use serde::{Serialize, Serializer};

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
    /// The means, in the order of `metrics`.
    pub values: Vec<f32>,
    /// What was last measured on held-out episodes, by name.
    pub held_out: Vec<(String, f32)>,
}

impl Serialize for Row {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(2 + self.values.len() + self.held_out.len()))?;
        map.serialize_entry("step", &self.step)?;
        map.serialize_entry("seconds", &self.seconds)?;
        for (metric, value) in self.metrics.iter().zip(&self.values) {
            map.serialize_entry(metric.name, value)?;
        }
        for (name, value) in &self.held_out {
            map.serialize_entry(name, value)?;
        }
        map.end()
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
