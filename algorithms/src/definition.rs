//! An algorithm before it runs: its name, presets, hyper-parameters, metrics, and what reports say
//! of it.

use std::collections::BTreeMap;

use quad_dataset::Window;
use quad_policy::Chunk;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize, Serializer};
use toml::{Table, Value};

use super::algorithm::Algorithm;
use super::context::Context;
use super::error::{AgentError, AlgorithmError, check};
use super::examples::Columns;
use super::hyperparameters::Count;

/// An algorithm before it runs.
#[derive(Clone, Copy)]
pub struct Definition {
    /// Its name on the command line and in files.
    pub name: &'static str,
    /// The contents of `presets/NAME.toml`.
    pub presets: &'static str,
    /// The metrics of its updates; some are measured in one phase only.
    pub metrics: &'static [Metric],
    /// The hyper-parameter that tells its variants apart, if it has any.
    pub variant: Option<Variant>,
    /// The hyper-parameter over which its paper draws scores.
    pub axis: Option<Axis>,
    /// The hyper-parameter with the step after which the target actor moves, where that acts.
    pub acts_after: Option<&'static str>,
    /// Summary of a run's metrics.
    pub summary: Option<Summarize>,
    /// True if it can learn chunks of actions (`agent.chunk`) from several observations
    /// (`agent.history`).
    pub chunks: bool,
    /// False if it can learn from experience alone.
    pub needs_data: bool,
    /// Reads an `[agent]` table, without `chunk`, `replan` and `history`, into the type of its
    /// hyper-parameters.
    pub read: fn(&Table) -> Result<Start, AgentError>,
}

impl Definition {
    /// An algorithm that learns single actions, with neither variants nor figures of its own.
    pub const PLAIN: Self = Self {
        name: "",
        presets: "",
        metrics: &[],
        variant: None,
        axis: None,
        acts_after: None,
        summary: None,
        chunks: false,
        needs_data: true,
        read: |_| unreachable!("an algorithm reads its own table"),
    };

    /// Checks an `[agent]` table.
    ///
    /// # Errors
    /// A key is missing, unknown, of the wrong type or out of range.
    pub fn check(&self, table: &Table) -> Result<(), AgentError> {
        self.read(table).map(drop)
    }

    /// Reads an `[agent]` table: the chunk and its windows, and all else as the algorithm does.
    pub(super) fn read(&self, table: &Table) -> Result<(Chunk, Window, Start), AgentError> {
        let mut own = table.clone();
        let (chunk, window) = take_chunk(&mut own)?;
        if (chunk.length > 1 || chunk.history > 1) && !self.chunks {
            return Err(AgentError::NoChunks(self.name));
        }
        Ok((chunk, window, (self.read)(&own)?))
    }
}

/// The keys of an `[agent]` table of a chunk: the actions of several steps in a row, which an
/// algorithm learns as one action (Li, Zhou and Levine 2025, "Reinforcement Learning with Action
/// Chunking"), in view of the last observations.
///
/// Batches have windows of steps in place of transitions, and nothing else of an algorithm changes:
/// its networks know a chunk as one long action and a history as one long observation, its targets
/// discount what follows a window by the steps in it, and what it predicts for actions beyond the end
/// of an episode is not learned ([`Batch`](super::Batch)).
#[derive(Deserialize)]
struct ChunkKeys {
    /// Steps h of a chunk; 1 if absent.
    chunk: Option<Count>,
    /// Steps that are executed of a chunk; all if absent.
    replan: Option<Count>,
    /// Observations that are seen at a time; 1 if absent.
    history: Option<Count>,
}

/// Takes these keys from an `[agent]` table: the chunk, and the windows of steps to learn it from.
fn take_chunk(table: &mut Table) -> Result<(Chunk, Window), AgentError> {
    let keys = ChunkKeys::deserialize(table.clone())?;
    let length = keys.chunk.map_or(1, |length| *length);
    let replan = keys.replan.map_or(length, |replan| *replan);
    check("replan", replan, replan <= length, "at most agent.chunk (--agent replan=K changes it)")?;
    let history = keys.history.map_or(1, |history| *history);
    for key in ["chunk", "replan", "history"] {
        table.remove(key);
    }
    let number = |value: &Value| value.as_float().or(value.as_integer().map(|whole| whole as f64));
    let gamma = table.get("gamma").and_then(number).unwrap_or(1.0) as f32;
    Ok((Chunk { history, length, replan }, Window { history, length, gamma }))
}

type Constructor = dyn FnOnce(Context) -> Result<Box<dyn Algorithm>, AlgorithmError>;

/// Makes an algorithm at step 0 with hyper-parameters that were read before.
pub struct Start {
    /// What it asks of batches.
    pub columns: Columns,
    /// Its constructor.
    pub new: Box<Constructor>,
}

/// A [`Start`] with plain batches from hyper-parameters and a constructor.
pub(super) fn start<C: 'static, A: Algorithm + 'static, E>(
    config: C,
    new: impl FnOnce(C, Context) -> Result<A, E> + 'static,
) -> Start
where
    AlgorithmError: From<E>,
{
    let new = |context| -> Result<Box<dyn Algorithm>, _> { Ok(Box::new(new(config, context)?)) };
    Start { columns: Columns::Plain, new: Box::new(new) }
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
