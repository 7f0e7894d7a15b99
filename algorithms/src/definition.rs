//! What is known of an algorithm before it runs: its values, its checks, what it measures, and what
//! reports say of it.

use std::collections::BTreeMap;

use serde::de::DeserializeOwned;
use serde::{Serialize, Serializer};

use super::algorithm::{AgentError, Algorithm, AlgorithmError};
use super::context::Context;

/// An algorithm before it runs.
#[derive(Clone, Copy)]
pub struct Definition {
    /// Its name on the command line and in files.
    pub name: &'static str,
    /// The file of its values for each task, `presets/NAME.toml`.
    pub settings: &'static str,
    /// What its updates measure, each what its phase has.
    pub metrics: &'static [Metric],
    /// How reports call its runs, and what they say of them beside scores.
    pub report: Reporting,
    /// Checks its hyper-parameters, the `[agent]` table of a preset.
    pub check: fn(&toml::Table) -> Result<(), AgentError>,
    /// The algorithm at step 0, of such a table.
    pub start: fn(&toml::Table, Context) -> Started,
}

/// An algorithm, or why it cannot start.
pub type Started = Result<Box<dyn Algorithm>, AlgorithmError>;

/// A number that an update measures. Gauges, `metrics.jsonl`, the progress display and `learner
/// presets --metrics` derive from it.
#[derive(Clone, Copy, Debug)]
pub struct Metric {
    /// Its name in `metrics.jsonl`; Prometheus sees `quad_learner_<name>`.
    pub name: &'static str,
    /// What it is, with its equation and, where it has one, its unit.
    pub help: &'static str,
    /// What the progress display calls it; empty where it does not show it.
    pub label: &'static str,
    /// Whether it is also measured on held-out episodes: it says something of data that is not
    /// learned from.
    pub held_out: bool,
}

/// A table of metrics: in each line a name, in brackets what the display calls it if it shows it,
/// `held_out` if it is also measured on held-out episodes, and the help.
macro_rules! metrics {
    (@ held_out) => { true };
    (@) => { false };
    ($($name:ident $([$label:literal])? $($held_out:ident)? : $help:expr;)*) => {
        [$($crate::definition::Metric {
            name: stringify!($name),
            help: $help,
            label: concat!($($label)?),
            held_out: $crate::definition::metrics!(@ $($held_out)?),
        }),*]
    };
}
pub(crate) use metrics;

/// What reports have to know of an algorithm.
#[derive(Clone, Copy)]
pub struct Reporting {
    /// What tells its variants apart, if it has any.
    pub variant: Option<Variant>,
    /// Counts among the hyper-parameters that reports name with a run, such as `candidates`.
    pub counts: &'static [&'static str],
    /// What its paper draws scores over.
    pub axis: Option<Axis>,
    /// What a run's metrics say about it.
    pub summary: Option<Summarize>,
}

impl Reporting {
    /// For an algorithm with neither variants nor figures of its own.
    pub const PLAIN: Self = Self { variant: None, counts: &[], axis: None, summary: None };
}

/// The hyper-parameter that tells an algorithm's variants apart.
#[derive(Clone, Copy)]
pub struct Variant {
    /// Its name.
    pub key: &'static str,
    /// What tables and figures call the variant with this value.
    pub called: fn(&str) -> String,
}

/// A hyper-parameter over which scores are drawn, on a logarithmic scale.
#[derive(Clone, Copy)]
pub struct Axis {
    /// Its name.
    pub key: &'static str,
    /// Its symbol in the paper.
    pub symbol: &'static str,
}

/// Summarizes the metrics of a run of a variant, if there is something to say.
pub type Summarize = fn(&[MetricsLine], &str) -> Option<Summary>;

/// A line of `metrics.jsonl`: means over some steps, by name.
pub type MetricsLine = BTreeMap<String, f64>;

/// What an algorithm says about the metrics of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Summary {
    /// Its key in JSON.
    pub key: &'static str,
    /// Its title.
    pub title: &'static str,
    /// The numbers in it.
    pub json: serde_json::Value,
    /// As lines for people.
    pub text: String,
}

impl Serialize for Summary {
    /// A map of `key` to `json`.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map([(self.key, &self.json)])
    }
}

/// Reads a table of hyper-parameters, whose types say their ranges.
pub(super) fn read<T: DeserializeOwned>(table: &toml::Table) -> Result<T, AgentError> {
    Ok(T::deserialize(table.clone())?)
}

/// Reads hyper-parameters into which those of `C` are flattened. Serde does not say which key of a
/// flattened struct is refused, so these are read by themselves first.
pub(super) fn read_with<C: DeserializeOwned, T: DeserializeOwned>(
    table: &toml::Table,
) -> Result<T, AgentError> {
    readable::<C>(table)?;
    read(table)
}

/// The check of hyper-parameters whose types say their ranges.
pub(super) fn readable<T: DeserializeOwned>(table: &toml::Table) -> Result<(), AgentError> {
    read::<T>(table).map(drop)
}
