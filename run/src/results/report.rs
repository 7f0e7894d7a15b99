//! The results of one run, and of its evaluations.

use std::collections::BTreeSet;
use std::path::PathBuf;

use clap::ValueEnum;
use quad_algorithms::Summary;
use quad_dataset::environment;
use serde::Serialize;

use super::judgment::Judgment;
use super::published;
use super::statistics::{Spread, mean};
use crate::config::{Experiment, RunConfig};
use crate::folder::ScoreLine;

/// The results of one run.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[allow(missing_docs)] // The names say it.
pub struct RunReport {
    pub dir: PathBuf,
    pub run: String,
    /// The task, or the name of a user's file that names no task; where a report has several such
    /// tasks, also the environment and the data.
    pub task: String,
    pub algorithm: String,
    /// The variant of the algorithm, such as QUAD's guidance `quad`, `dac` or `none`; else the
    /// algorithm's name.
    pub variant: String,
    /// The most important hyper-parameters, as text.
    pub agent: String,
    pub seed: u64,
    pub steps: u64,
    /// True if scores are D4RL-normalized; else they are returns.
    pub normalized: bool,
    /// Precision of the policies that were scored; several if evaluators differed.
    pub scored_in: String,
    /// Mean score of the dataset's trajectories; absent without a dataset.
    pub dataset_score: Option<f64>,
    pub evaluations: Vec<EvaluationReport>,
    /// Episodes of planned evaluations without a score.
    pub episodes_missing: u64,
    /// Mean score of the last 3 complete evaluations, online of those after it has begun;
    /// absent if there are fewer.
    pub mean_last_3: Option<f64>,
    pub mean_last_5: Option<f64>,
    /// Absent for runs of 50,000 steps or fewer, online of those after it has begun.
    pub mean_last_50000_steps: Option<f64>,
    /// The algorithm's summary of its metrics, such as of QUAD's λ.
    #[serde(flatten)]
    pub summary: Option<Summary>,
    /// The variant's label in tables and figures.
    #[serde(skip)]
    pub label: String,
    /// True if evaluators define the score themselves, such as success.
    #[serde(skip)]
    pub(super) own_score: bool,
    /// Each precision of the policies that were scored.
    #[serde(skip)]
    pub precisions: BTreeSet<String>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub judgments: Vec<Judgment>,
    #[serde(skip)]
    pub config: RunConfig,
}

impl RunReport {
    /// Mean score of the last complete evaluations, as many as the task's published figures
    /// average; absent if there are fewer.
    pub fn score(&self) -> Option<f64> {
        match published::final_evaluations(&self.config.run.task) {
            3 => self.mean_last_3,
            _ => self.mean_last_5,
        }
    }

    /// True if every episode of every evaluation has its score.
    pub fn is_complete(&self) -> bool {
        self.episodes_missing == 0
    }

    /// The evaluation with the largest score, of those that count.
    pub fn best(&self) -> Option<&EvaluationReport> {
        self.best_of(|_| true)
    }

    /// The best evaluation that counts, among those of matching steps; of equal ones the latest.
    pub fn best_of(&self, matches: impl Fn(u64) -> bool) -> Option<&EvaluationReport> {
        let counted = self.evaluations.iter().filter(|e| e.counts() && matches(e.step));
        counted.max_by(|one, other| one.score.mean.total_cmp(&other.score.mean))
    }

    /// The last complete evaluation.
    pub fn newest(&self) -> Option<&EvaluationReport> {
        self.complete().next_back()
    }

    fn complete(&self) -> impl DoubleEndedIterator<Item = &EvaluationReport> {
        self.evaluations.iter().filter(|evaluation| evaluation.complete)
    }

    /// Number of planned evaluations that are complete.
    pub fn evaluations_complete(&self) -> usize {
        let schedule = self.config.experiment.schedule();
        self.complete().filter(|evaluation| schedule.is_evaluated(evaluation.step)).count()
    }

    /// The step of the last complete evaluation of a run that is not complete.
    pub fn reached(&self) -> Option<u64> {
        (!self.is_complete()).then_some(self.newest().map_or(0, |evaluation| evaluation.step))
    }

    /// The progress of a run that is not complete, in words.
    pub fn how_complete(&self) -> String {
        format!(
            "{} of {} evaluations are complete, the last of them after {} of {} steps",
            self.evaluations_complete(),
            self.config.experiment.schedule().evaluations(),
            self.reached().unwrap_or(self.steps),
            self.steps
        )
    }

    /// `score` or `return`, whichever the scores are.
    pub fn measure(&self) -> &'static str {
        match self.normalized || self.own_score {
            true => "score",
            false => "return",
        }
    }

    /// [`Self::measure`] of the dataset's trajectories, their mean; absent without a dataset, and where
    /// evaluators define the score, which the dataset does not have.
    pub fn dataset_measure(&self) -> Option<f64> {
        self.dataset_score.filter(|_| !self.own_score)
    }

    /// [`Self::measure`] with its unit; in a maze, the fraction of episodes that reach the goal.
    pub fn measure_with_unit(&self) -> &'static str {
        match environment::find(&self.config.experiment.environment) {
            Ok(environment) if environment.maze.is_some() => "success rate in %",
            Ok(_) => "D4RL-normalized score",
            Err(_) => self.measure(),
        }
    }
}

/// The episodes of one snapshot.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EvaluationReport {
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Online environment steps that the gradient steps up to `step` wait for; absent in a run
    /// without any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub environment_steps: Option<u64>,
    /// Scored episodes.
    pub episodes: usize,
    /// True if all episodes are scored.
    pub complete: bool,
    /// Score over the episodes: D4RL-normalized, or the return where the environment has no
    /// reference returns.
    pub score: Spread,
    /// Mean undiscounted return.
    pub mean_return: f64,
    /// Mean length in environment steps.
    pub mean_length: f64,
}

impl EvaluationReport {
    /// True if it makes its run's score: it is complete and, in an online run, of a policy that
    /// has learned online.
    pub fn counts(&self) -> bool {
        self.complete && self.environment_steps != Some(0)
    }

    /// Summarizes the episodes of the snapshot at `step`; `None` without episodes.
    pub(super) fn new(step: u64, episodes: &[&ScoreLine], experiment: &Experiment) -> Option<Self> {
        let values =
            |value: fn(&ScoreLine) -> f64| Vec::from_iter(episodes.iter().map(|line| value(line)));
        Some(Self {
            step,
            environment_steps: experiment.environment_steps(step),
            episodes: episodes.len(),
            complete: episodes.len() == experiment.episodes as usize,
            score: Spread::new(&values(|line| line.score))?,
            mean_return: mean(&values(|line| line.episode_return)),
            mean_length: mean(&values(|line| line.length.into())),
        })
    }
}

/// The evaluations of a run that make its score. (The help of `learner report` has these lines.)
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Select {
    /// The last ones, as in the paper
    Last,
    /// The best one: optimistic, because it is chosen by the very scores that are reported
    Best,
}

impl Select {
    /// A warning for the reader of figures that do not follow the paper's protocol.
    pub fn warning(self) -> Option<&'static str> {
        const SELECTED: &str = "Selected: of each run its best complete evaluation counts, in place of the mean of its last ones. It is chosen by the very \
             scores that are reported, so it is optimistic, and the more so the more evaluations there are.\n";
        (self == Self::Best).then_some(SELECTED)
    }
}
