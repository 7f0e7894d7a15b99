//! Summary of a dataset for its user: statistics, histograms and problems.

mod histogram;
mod page;

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::error::{DatasetError, Problem};
use crate::formats::Source;
use crate::read_options::ReadOptions;
use crate::statistics::Summary;
use crate::tables::benchmarks;
use crate::tables::environment::{self, EnvironmentSpec};
use crate::tables::reward::{RewardRule, RewardScaling};
use crate::{checks, warnings};

pub use histogram::Histogram;

/// Statistics and problems of a dataset: lengths of episodes in steps, and ranges of the numbers in a
/// column or in all. Numbers that are not finite are excluded; a statistic of no numbers is NaN, null
/// in JSON.
#[derive(Debug, Serialize)]
#[allow(missing_docs)] // The names say what each is.
pub struct Inspection {
    pub path: PathBuf,
    /// `D4RL`, `Minari`, `OGBench` or `transitions`, the custom layout.
    pub format: &'static str,
    /// Environment given by the caller, else the one named in the file.
    pub environment: Option<String>,
    pub transitions: usize,
    /// Number of episodes, including one truncated by the end of the file.
    pub episodes: usize,
    pub observation_dim: usize,
    pub action_dim: usize,
    pub min_length: f64,
    pub mean_length: f64,
    pub max_length: f64,
    /// Smallest undiscounted return, as in [`Statistics`](crate::Statistics).
    pub min_return: f64,
    pub mean_return: f64,
    pub max_return: f64,
    /// Normalized scores by D4RL's reference returns, if the environment is known.
    #[serde(flatten)]
    pub scores: Option<Scores>,
    /// Empty if the source has none.
    pub observation_names: Vec<String>,
    pub action_names: Vec<String>,
    /// Indices of constant observation dimensions.
    pub constant_observations: Vec<usize>,
    pub constant_actions: Vec<usize>,
    /// Root mean square of the rewards; hyperparameters are tuned for about 1.
    pub reward_size: f64,
    pub reward_range: Range,
    pub action_range: Range,
    pub action_ranges: Vec<Range>,
    pub observation_range: Range,
    pub observation_ranges: Vec<Range>,
    /// Fraction of the steps after which the task ended.
    pub terminals: f64,
    /// Fraction of the steps after which the episode was truncated.
    pub timeouts: f64,
    pub returns: Histogram,
    pub lengths: Histogram,
    /// Problems, one sentence each: first those that training refuses.
    pub problems: Vec<String>,
    /// True if `learner train` refuses the dataset even with `--normalize actions`.
    pub refused: bool,
}

/// Normalized scores of the episodes.
#[derive(Debug, Serialize)]
#[allow(missing_docs)] // The names say what each is.
pub struct Scores {
    pub min_score: f64,
    pub mean_score: f64,
    pub max_score: f64,
}

impl Scores {
    fn of(returns: Summary, spec: &EnvironmentSpec) -> Self {
        Self {
            min_score: spec.normalized_score(returns.min),
            mean_score: spec.normalized_score(returns.mean),
            max_score: spec.normalized_score(returns.max),
        }
    }
}

/// Smallest and largest of some numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[allow(missing_docs)] // The names say what each is.
pub struct Range {
    pub min: f64,
    pub max: f64,
}

impl Range {
    fn of_columns(values: &[f32], width: usize, counts: impl Fn(usize) -> bool) -> Vec<Self> {
        let columns = Summary::of_columns(values, width, counts).into_iter();
        columns.map(|Summary { min, max, .. }| Self { min, max }).collect()
    }

    fn constant(ranges: &[Self]) -> Vec<usize> {
        (0..ranges.len()).filter(|&i| ranges[i].min == ranges[i].max).collect()
    }

    fn over(ranges: &[Self]) -> Self {
        let min = ranges.iter().map(|range| range.min).fold(f64::NAN, f64::min);
        let max = ranges.iter().map(|range| range.max).fold(f64::NAN, f64::max);
        Self { min, max }
    }
}

/// Summarizes a dataset of any format. Bad numbers are listed as problems; only an unreadable
/// source is an error. The environment defaults to the one named in the file, if known.
pub fn inspect(
    path: impl AsRef<Path>,
    environment: Option<&'static EnvironmentSpec>,
) -> Result<Inspection, DatasetError> {
    let path = path.as_ref();
    let mut source = Source::open(path)?;
    let claimed = source.environment();
    let spec = environment.or_else(|| environment::find(claimed.as_deref()?).ok());
    let reward = spec.map_or(RewardRule::AsIs, |spec| spec.reward);
    let task = spec.and_then(|spec| benchmarks::relabeling(&spec.name));
    let recording = source.read(spec, task)?;

    let other = environment.and_then(|environment| source.check_environment(environment).err());
    let refused: Vec<Problem> =
        other.into_iter().chain(checks::problems(&recording, spec)).collect();
    let doubts = warnings::warnings(&recording, &ReadOptions { reward, ..ReadOptions::default() });

    let with_hint = |problem: &Problem| format!("{problem}; {}", problem.hint());

    let episodes = recording.episodes();
    let lengths: Vec<f64> = episodes.iter().map(|episode| episode.length as f64).collect();
    let returns: Vec<f64> =
        episodes.iter().map(|episode| episode.sum).filter(|sum| sum.is_finite()).collect();
    let (length, sum) = (Summary::of(&lengths), Summary::of(&returns));
    let steps: f64 = lengths.iter().sum();
    let share = |flags: &[bool]| flags.iter().filter(|&&flag| flag).count() as f64 / steps;
    let is_step = |row: usize| recording.is_step(row);
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
        scores: spec.map(|spec| Scores::of(sum, spec)),
        constant_observations: Range::constant(&observation_ranges),
        constant_actions: Range::constant(&action_ranges),
        reward_size: RewardScaling::default().rms(&recording),
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
        problems: refused.iter().map(with_hint).chain(doubts).collect(),
    })
}
