//! A description of a dataset for people.
//!
//! `findings` is what looks wrong though training puts up with it, `histogram` counts, and `page`
//! is how it all looks.

mod findings;
mod histogram;
mod page;

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::checks;
use crate::error::{DatasetError, Problem};
use crate::formats::Source;
use crate::recording::RowKind;
use crate::statistics::Extent;
use crate::tables::benchmarks;
use crate::tables::environment::{self, EnvironmentSpec};
use crate::tables::reward::RewardScaling;

pub use histogram::Histogram;

/// Figures of a dataset, and what is wrong with it. Numbers that are not finite are left out of
/// every figure; a figure of nothing is NaN, which JSON has as null.
#[derive(Debug, Serialize)]
pub struct Inspection {
    /// The file or folder.
    pub path: PathBuf,
    /// The format it was read as: `D4RL`, `Minari`, `OGBench` or `transitions`, the custom layout.
    pub format: &'static str,
    /// The environment that it was inspected as: the one that was asked for, or else the one that
    /// it says it is from.
    pub environment: Option<String>,
    /// Transitions to learn from.
    pub transitions: usize,
    /// Recorded episodes; one that the end of the file cuts off counts as well.
    pub episodes: usize,
    /// Numbers in an observation.
    pub observation_dim: usize,
    /// Numbers in an action.
    pub action_dim: usize,
    /// Fewest steps in an episode.
    pub min_length: f64,
    /// Mean number of steps in an episode.
    pub mean_length: f64,
    /// Most steps in an episode.
    pub max_length: f64,
    /// Smallest undiscounted return of an episode, as in [`Statistics`](crate::Statistics).
    pub min_return: f64,
    /// Mean return.
    pub mean_return: f64,
    /// Largest return.
    pub max_return: f64,
    /// Smallest, mean and largest score by D4RL's reference returns, where the environment is
    /// known.
    #[serde(flatten)]
    pub scores: Option<Scores>,
    /// What the source calls the numbers of an observation; empty where they have no names.
    pub observation_names: Vec<String>,
    /// Names of the numbers of an action.
    pub action_names: Vec<String>,
    /// Numbers of an observation that never change, from 0.
    pub constant_observations: Vec<usize>,
    /// Those of an action.
    pub constant_actions: Vec<usize>,
    /// Root mean square of the rewards; methods are made for about 1.
    pub reward_size: f64,
    /// Smallest and largest reward.
    pub reward_range: Range,
    /// Smallest and largest number in an action.
    pub action_range: Range,
    /// Smallest and largest value of each of an action's numbers.
    pub action_ranges: Vec<Range>,
    /// Smallest and largest number in an observation.
    pub observation_range: Range,
    /// Smallest and largest value of each of an observation's numbers.
    pub observation_ranges: Vec<Range>,
    /// Share of the steps that are terminal.
    pub terminals: f64,
    /// Share of the steps at which an episode was cut off.
    pub timeouts: f64,
    /// How many episodes have which return.
    pub returns: Histogram,
    /// How many episodes have which length.
    pub lengths: Histogram,
    /// What is wrong, one sentence each: first what training refuses, then what it puts up with.
    pub problems: Vec<String>,
    /// Whether `learner train` refuses it, also with `--normalize actions`.
    pub refused: bool,
}

/// Normalized scores of the episodes.
#[derive(Debug, Serialize)]
pub struct Scores {
    /// Smallest.
    pub min_score: f64,
    /// Mean.
    pub mean_score: f64,
    /// Largest.
    pub max_score: f64,
}

/// The smallest and the largest of some numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Range {
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
}

impl Range {
    fn of(values: impl Iterator<Item = f32>) -> Self {
        let Extent { min, max, .. } =
            Extent::of(values.map(f64::from).filter(|value| value.is_finite()));
        Self { min, max }
    }

    /// Finds the range of each of a row's `width` numbers, over the rows that are asked for.
    fn of_columns(values: &[f32], width: usize, rows: impl Fn(usize) -> bool) -> Vec<Self> {
        let column = |column: usize| {
            let values = values.iter().skip(column).step_by(width).enumerate();
            Self::of(values.filter(|(row, _)| rows(*row)).map(|(_, value)| *value))
        };
        (0..width).map(column).collect()
    }

    /// The columns that have but one value.
    fn constant(ranges: &[Self]) -> Vec<usize> {
        (0..ranges.len()).filter(|&i| ranges[i].min == ranges[i].max).collect()
    }

    fn over(ranges: &[Self]) -> Self {
        let min = ranges.iter().map(|range| range.min).fold(f64::NAN, f64::min);
        let max = ranges.iter().map(|range| range.max).fold(f64::NAN, f64::max);
        Self { min, max }
    }
}

/// Describes a dataset of any format. Whatever is wrong with its numbers becomes a problem on the
/// list; an error is what leaves nothing to describe, such as a file that HDF5 does not open.
///
/// Where no environment is asked for, it is the one that the source says it was recorded in, if we
/// know that one.
pub fn inspect(
    path: impl AsRef<Path>,
    environment: Option<&'static EnvironmentSpec>,
) -> Result<Inspection, DatasetError> {
    let path = path.as_ref();
    let mut source = Source::open(path)?;
    let claimed = source.environment();
    let spec = environment.or_else(|| environment::find(claimed.as_deref()?).ok());
    let recording = source.read(spec, spec.and_then(|spec| benchmarks::relabeling(&spec.name)))?;

    let other = environment.and_then(|environment| source.check_environment(environment).err());
    let refused: Vec<Problem> =
        other.into_iter().chain(checks::problems(&recording, spec)).collect();
    let findings = findings::findings(&source, &recording, spec);

    let episodes = recording.episodes();
    let lengths: Vec<f64> = episodes.iter().map(|episode| episode.length as f64).collect();
    let returns: Vec<f64> =
        episodes.iter().map(|episode| episode.sum).filter(|sum| sum.is_finite()).collect();
    let (length, sum) = (Extent::of(lengths.iter().copied()), Extent::of(returns.iter().copied()));
    let steps: f64 = lengths.iter().sum();
    let share = |flags: &[bool]| flags.iter().filter(|&&flag| flag).count() as f64 / steps;
    let is_step = |row: usize| recording.kinds[row] != RowKind::LastState;
    let action_ranges = Range::of_columns(&recording.actions, recording.action_dim, is_step);
    let observation_ranges =
        Range::of_columns(&recording.observations, recording.observation_dim, |_| true);
    let reward_ranges = Range::of_columns(&recording.rewards, 1, is_step);
    Ok(Inspection {
        path: path.into(),
        format: source.format(),
        environment: spec.map(|spec| spec.name.clone()).or(claimed),
        transitions: recording.transitions().count(),
        episodes: episodes.len(),
        observation_dim: recording.observation_dim,
        action_dim: recording.action_dim,
        min_length: length.min,
        mean_length: length.mean,
        max_length: length.max,
        min_return: sum.min,
        mean_return: sum.mean,
        max_return: sum.max,
        scores: spec.map(|spec| Scores {
            min_score: spec.normalized_score(sum.min),
            mean_score: spec.normalized_score(sum.mean),
            max_score: spec.normalized_score(sum.max),
        }),
        constant_observations: Range::constant(&observation_ranges),
        constant_actions: Range::constant(&action_ranges),
        reward_size: RewardScaling::default().size(&recording),
        observation_names: recording.names.observations,
        action_names: recording.names.actions,
        reward_range: Range::over(&reward_ranges),
        action_range: Range::over(&action_ranges),
        action_ranges,
        observation_range: Range::over(&observation_ranges),
        observation_ranges,
        terminals: share(&recording.terminals),
        timeouts: share(&recording.timeouts),
        returns: Histogram::of(&returns),
        lengths: Histogram::of(&lengths),
        refused: !refused.is_empty(),
        problems: refused.iter().map(Problem::to_string).chain(findings).collect(),
    })
}
