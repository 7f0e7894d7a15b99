//! An algorithm before it runs: its name, presets, hyper-parameters, metrics, and what reports say
//! of it.

use std::collections::BTreeMap;
use std::fmt;
use std::ops::Deref;
use std::sync::Arc;

use quad_policy::Chunk;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize, Serializer};
use toml::Table;

use super::algorithm::Algorithm;
use super::chunk;
use super::context::Context;
use super::error::{AgentError, AlgorithmError};

/// An algorithm before it runs.
#[derive(Clone, Copy)]
pub struct Definition {
    /// Its name on the command line and in files.
    pub name: &'static str,
    /// The contents of `presets/NAME.toml`.
    pub presets: &'static str,
    /// The metrics of its updates; some are measured in one phase only.
    pub metrics: &'static [Metric],
    /// Texts of reports about its runs, beside scores.
    pub report: Reporting,
    /// True if it can learn chunks of actions (`agent.chunk`) from several observations
    /// (`agent.history`).
    pub chunks: bool,
    /// Reads an `[agent]` table, without `chunk`, `replan` and `history`, into the type of its
    /// hyper-parameters.
    pub read: fn(&Table) -> Result<Start, AgentError>,
}

impl Definition {
    /// Reads an `[agent]` table: the chunk, and all else as the algorithm does.
    fn start(&self, table: &Table) -> Result<(Chunk, Start), AgentError> {
        let mut own = table.clone();
        let (chunk, window) = chunk::take(&mut own)?;
        if (chunk.length > 1 || chunk.history > 1) && !self.chunks {
            return Err(AgentError::NoChunks(self.name));
        }
        let start = (self.read)(&own)?;
        Ok((chunk, Arc::new(move |context| start(Context { window, ..context }))))
    }
}

/// Makes an algorithm at step 0 with hyper-parameters that were read before.
pub type Start = Arc<dyn Fn(Context) -> Result<Box<dyn Algorithm>, AlgorithmError> + Send + Sync>;

/// Makes a [`Start`] of hyper-parameters and a constructor.
pub(super) fn start<C, A, E>(
    config: C,
    new: impl Fn(C, Context) -> Result<A, E> + Send + Sync + 'static,
) -> Start
where
    C: Clone + Send + Sync + 'static,
    A: Algorithm + 'static,
    AlgorithmError: From<E>,
{
    Arc::new(move |context| Ok(Box::new(new(config.clone(), context)?)))
}

/// Reads a table of hyper-parameters, whose types check their ranges.
pub(super) fn read<T: DeserializeOwned>(table: &Table) -> Result<T, AgentError> {
    Ok(T::deserialize(table.clone())?)
}

/// Reads hyper-parameters into which those of `C` are flattened. Serde does not name the key of a
/// flattened struct that it refuses, so these are read by themselves first.
pub(super) fn read_with<C: DeserializeOwned, T: DeserializeOwned>(
    table: &Table,
) -> Result<T, AgentError> {
    read::<C>(table)?;
    read(table)
}

/// The hyper-parameters of an algorithm: the `[agent]` table of an experiment and, once it was
/// checked, the same as the algorithm's own type.
#[derive(Clone, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Hyperparameters {
    table: Table,
    #[serde(skip)]
    start: Option<(Chunk, Start)>,
}

impl Hyperparameters {
    /// Reads a table for an algorithm.
    ///
    /// # Errors
    /// A key is missing, unknown, of the wrong type or out of range.
    pub fn new(definition: &Definition, table: Table) -> Result<Self, AgentError> {
        Ok(Self { start: Some(definition.start(&table)?), table })
    }

    /// A copy of the table.
    pub fn to_table(&self) -> Table {
        self.table.clone()
    }

    /// The algorithm at step 0, and the chunk that its policy knows as one action. A table that comes
    /// from a run's folder is read here.
    ///
    /// # Errors
    /// The table cannot be used, the data has no examples for the algorithm, or candle fails.
    pub fn start(
        &self,
        definition: &Definition,
        context: Context,
    ) -> Result<(Chunk, Box<dyn Algorithm>), AlgorithmError> {
        let (chunk, start) = match &self.start {
            Some(start) => start.clone(),
            None => definition.start(&self.table)?,
        };
        Ok((chunk, start(context)?))
    }
}

impl Deref for Hyperparameters {
    type Target = Table;

    fn deref(&self) -> &Table {
        &self.table
    }
}

impl From<Table> for Hyperparameters {
    fn from(table: Table) -> Self {
        Self { table, start: None }
    }
}

impl PartialEq for Hyperparameters {
    fn eq(&self, other: &Self) -> bool {
        self.table == other.table
    }
}

impl fmt::Debug for Hyperparameters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.table.fmt(f)
    }
}

/// A number that an update measures. Gauges, `metrics.jsonl`, the progress display and `learner
/// presets --metrics` derive from it.
#[derive(Clone, Copy, Debug)]
pub struct Metric {
    /// Its name in `metrics.jsonl`; Prometheus sees `quad_learner_<name>`.
    pub name: &'static str,
    /// Its description with the equation and, where it has one, the unit.
    pub help: &'static str,
    /// Its label in the progress display; empty if it is not shown there.
    pub label: &'static str,
    /// Also measured on held-out episodes.
    pub held_out: bool,
}

/// A table of metrics: each line has a name, the label in brackets, `held_out` if it is also
/// measured on held-out episodes, and the help.
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

/// Texts of reports about an algorithm's runs, beside scores.
#[derive(Clone, Copy)]
pub struct Reporting {
    /// The hyper-parameter that tells its variants apart, if it has any.
    pub variant: Option<Variant>,
    /// The hyper-parameter over which its paper draws scores.
    pub axis: Option<Axis>,
    /// The hyper-parameter with the step after which the target actor moves, where that acts.
    pub acts_after: Option<&'static str>,
    /// Summary of a run's metrics.
    pub summary: Option<Summarize>,
}

impl Reporting {
    /// For an algorithm with neither variants nor figures of its own.
    pub const PLAIN: Self = Self { variant: None, axis: None, acts_after: None, summary: None };
}

/// The hyper-parameter that tells an algorithm's variants apart.
#[derive(Clone, Copy)]
pub struct Variant {
    /// Its key in the `[agent]` table.
    pub key: &'static str,
    /// The label of the variant with this value in tables and figures.
    pub called: fn(&str) -> String,
    /// Hyper-parameters that change no policy of the variant with this value.
    pub unused: fn(&str) -> &'static [&'static str],
}

/// A hyper-parameter over which scores are drawn, on a logarithmic scale.
#[derive(Clone, Copy)]
pub struct Axis {
    /// Its key in the `[agent]` table.
    pub key: &'static str,
    /// Its symbol in the paper.
    pub symbol: &'static str,
}

/// Summarizes the metrics of a run of a variant, if there is something to say.
pub type Summarize = fn(&[MetricsLine], &str) -> Option<Summary>;

/// A line of `metrics.jsonl`: means over some steps, by name.
pub type MetricsLine = BTreeMap<String, f64>;

/// An algorithm's summary of the metrics of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Summary {
    /// Its key in JSON.
    pub key: &'static str,
    /// Its heading in the report's page.
    pub title: &'static str,
    /// Its numbers, an object.
    pub json: serde_json::Value,
    /// Its lines for people.
    pub text: String,
}

impl Serialize for Summary {
    /// Writes a map of `key` to `json`.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map([(self.key, &self.json)])
    }
}
