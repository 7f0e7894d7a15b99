//! The results of one run.

use std::collections::BTreeSet;
use std::path::PathBuf;

use quad_algorithms::Summary;
use quad_dataset::environment;
use serde::Serialize;

use super::evaluation::EvaluationReport;
use super::judgment::Judgment;
use super::published;
use crate::config::RunConfig;

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
    /// Mean score of the dataset's trajectories.
    pub dataset_score: f64,
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

    /// The best evaluation that counts of the steps for which `is_one` holds; the last of equal ones.
    pub fn best_of(&self, is_one: impl Fn(u64) -> bool) -> Option<&EvaluationReport> {
        let chosen = self.evaluations.iter().filter(|it| it.counts() && is_one(it.step));
        chosen.max_by(|one, other| one.score.mean.total_cmp(&other.score.mean))
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

    /// [`Self::measure`] of the dataset's trajectories, their mean; absent where evaluators define the
    /// score, which the dataset does not have.
    pub fn dataset_measure(&self) -> Option<f64> {
        (!self.own_score).then_some(self.dataset_score)
    }

    /// [`Self::measure`] with its unit; in a maze, the fraction of episodes that reach the goal.
    pub fn measure_with_unit(&self) -> &'static str {
        match environment::find(&self.config.experiment.environment) {
            Ok(known) if known.maze.is_some() => "success rate in %",
            Ok(_) => "D4RL-normalized score",
            Err(_) => self.measure(),
        }
    }
}
