//! Summary of a dataset for its user: statistics, histograms and problems.

mod page;

use std::collections::BTreeSet;
use std::path::Path;

use serde::Serialize;

use crate::error::DatasetError;
use crate::files::{self, DatasetFile};
use crate::formats::{ReadOptions, Source, recorded_environment};
use crate::recording::Recording;
use crate::statistics::{Range, Summary};
use crate::tables::benchmarks;
use crate::tables::environment::{self, EnvironmentSpec};
use crate::tables::reward::{RewardRule, RewardScaling};
use crate::{checks, warnings};

pub use page::Histogram;

/// Statistics and problems of a dataset: lengths of episodes in steps, and ranges of the numbers in a
/// column or in all. Numbers that are not finite are excluded; a statistic of no numbers is NaN, null
/// in JSON.
#[derive(Debug, Serialize)]
#[allow(missing_docs)] // The names say what each is.
pub struct Inspection {
    pub files: Vec<DatasetFile>,
    /// `D4RL`, `Minari`, `OGBench` or `transitions`, the custom layout; several with commas.
    pub format: String,
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
    /// Standard deviation.
    pub score_std: f64,
}

fn constant(ranges: &[Range]) -> Vec<usize> {
    let is_constant = |i: &usize| ranges[*i].min == ranges[*i].max;
    (0..ranges.len()).filter(is_constant).collect()
}

/// Summarizes the files of a dataset. Bad numbers are listed as problems; only files that cannot be
/// read, or that do not fit each other, are an error. The environment defaults to the one that they
/// name, if known.
pub fn inspect(
    paths: &[impl AsRef<Path>],
    environment: Option<&'static EnvironmentSpec>,
) -> Result<Inspection, DatasetError> {
    let claimed = paths.iter().map(recorded_environment).collect::<Result<Vec<_>, _>>()?;
    let claimed = claimed.into_iter().flatten().next();
    let spec = environment.or_else(|| environment::find(claimed.as_deref()?).ok());
    let reward = spec.map_or(RewardRule::AsIs, |spec| spec.reward);
    let task = spec.and_then(|spec| benchmarks::relabeling(&spec.name));
    let options = ReadOptions { reward, ..ReadOptions::default() };
    let (mut refused, mut doubts, mut formats) = (Vec::new(), Vec::new(), BTreeSet::new());
    let check = |path: &Path, source: &Source, recording: &Recording| {
        let named = |problem| match paths {
            [_] => problem,
            _ => format!("{}: {problem}", path.display()),
        };
        let other = environment.and_then(|environment| source.check_environment(environment).err());
        let problems = other.into_iter().chain(checks::problems(recording, spec));
        let problems = problems.map(|problem| format!("{problem}; {}", problem.hint()));
        refused.extend(problems.map(named));
        doubts.extend(warnings::file_warnings(recording, &options).into_iter().map(named));
        formats.insert(source.format());
        Ok(())
    };
    let (recording, files) = files::read(paths, None, spec, task, check)?;
    doubts.extend(warnings::number_warnings(&recording, &options));
    let episodes = recording.episodes();
    let lengths = Vec::from_iter(episodes.iter().map(|episode| episode.length as f64));
    let returns = episodes.iter().map(|episode| episode.sum);
    let returns = Vec::from_iter(returns.filter(|sum| sum.is_finite()));
    let (length, sum) = (Summary::new(&lengths), Summary::new(&returns));
    let steps: f64 = lengths.iter().sum();
    let share = |flags: &[bool]| flags.iter().filter(|&&flag| flag).count() as f64 / steps;
    let is_step = |row: usize| recording.is_step(row);
    let (o, a) = (recording.observation_dim, recording.action_dim);
    let action_ranges = Range::columns(&recording.actions, a, is_step);
    let observation_ranges = Range::columns(&recording.observations, o, |_| true);
    let reward_ranges = Range::columns(&recording.rewards, 1, is_step);
    Ok(Inspection {
        files,
        format: Vec::from_iter(formats).join(", "),
        environment: spec.map(|spec| spec.name.clone()).or(claimed),
        transitions: recording.transitions().count(),
        episodes: episodes.len(),
        observation_dim: o,
        action_dim: a,
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
            score_std: spec.normalized_score(sum.deviation) - spec.normalized_score(0.0),
        }),
        constant_observations: constant(&observation_ranges),
        constant_actions: constant(&action_ranges),
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
        returns: Histogram::new(&returns),
        lengths: Histogram::new(&lengths),
        refused: !refused.is_empty(),
        problems: [refused, doubts].concat(),
    })
}
