//! One run: its folder, read and summarized.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Alignment::Right;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;
use quad_algorithms::Summary;
use quad_dataset::environment;
use serde::Serialize;

use super::evaluation::EvaluationReport;
use super::judgment::Judgment;
use super::published;
use super::spread::Spread;
use crate::config::RunConfig;
use crate::run::{RunDir, ScoreLine, read_metrics};
use crate::table::{Style, Table};

/// Gradient steps at the end of a run over which the paper's appendix B takes the mean.
const FINAL_STEPS: u64 = 50_000;

/// One run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RunReport {
    /// Its folder.
    pub dir: PathBuf,
    /// Its name.
    pub run: String,
    /// What it learns; of a user's file that names no task, the file's name.
    pub task: String,
    /// Its algorithm.
    pub algorithm: String,
    /// The variant of the algorithm: the kind of guidance for QUAD, such as `quad`, `dac` and
    /// `none`, or another algorithm's name.
    pub variant: String,
    /// The hyper-parameters that matter most.
    pub agent: String,
    /// Seed.
    pub seed: u64,
    /// Gradient steps.
    pub steps: u64,
    /// Whether scores are D4RL-normalized; without reference returns they are returns.
    pub normalized: bool,
    /// Precision that the policies were scored in; several, if evaluators differed.
    pub scored_in: String,
    /// Mean score of the dataset's trajectories, of the same kind.
    pub dataset_score: f64,
    /// Its evaluations by step.
    pub evaluations: Vec<EvaluationReport>,
    /// Episodes of all planned evaluations that have no score, or not yet.
    pub episodes_missing: u64,
    /// Mean score of the last 3 complete evaluations; absent if they are fewer.
    pub mean_last_3: Option<f64>,
    /// Mean score of the last 5 complete evaluations; absent if they are fewer.
    pub mean_last_5: Option<f64>,
    /// Mean score of the complete evaluations in the run's last 50,000 steps; absent if it has no
    /// more steps than that.
    pub mean_last_50000_steps: Option<f64>,
    /// What its algorithm says of its metrics, such as QUAD of λ, under a name of the algorithm's;
    /// absent if nothing.
    #[serde(flatten)]
    pub summary: Option<Summary>,
    /// What tables and figures call the variant.
    #[serde(skip)]
    pub called: String,
    /// True if the evaluator defines the score itself, such as success.
    #[serde(skip)]
    own_score: bool,
    /// Each precision that its policies were scored in.
    #[serde(skip)]
    pub precisions: BTreeSet<String>,
    /// What `learner judge` found out about its snapshots.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub judgments: Vec<Judgment>,
    /// Its configuration.
    #[serde(skip)]
    pub config: RunConfig,
}

impl RunReport {
    /// Reads a run folder.
    ///
    /// # Errors
    /// There is no run in it, or a file is not what a learner writes.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let scored = Self::scored(path)?;
        let summary = match scored.config.experiment.definition()?.report.summary {
            Some(summary) => summary(&read_metrics(path)?, &scored.variant),
            None => None,
        };
        Ok(Self { summary, ..scored })
    }

    /// Reads a run folder, but not `metrics.jsonl`, so that the report has no summary.
    ///
    /// # Errors
    /// Those of [`read`](Self::read).
    pub fn scored(path: &Path) -> anyhow::Result<Self> {
        Ok(Self::with_scores(path)?.0)
    }

    /// Reads what [`scored`](Self::scored) reads, and gives the episodes' scores, too.
    ///
    /// # Errors
    /// Those of [`read`](Self::read).
    pub fn with_scores(path: &Path) -> anyhow::Result<(Self, Vec<ScoreLine>)> {
        let (dir, config) = RunDir::open(path)?;
        let agent = config.experiment.method();
        let agent =
            agent.with_context(|| format!("config.toml in {} cannot be used", path.display()))?;
        let names = [agent, config.experiment.variant()?.to_owned(), config.experiment.called()?];
        let (scores, judgments) = (dir.read_scores()?, Judgment::read_all(&dir)?);
        Ok((Self { judgments, ..Self::new(path, config, names, &scores) }, scores))
    }

    fn new(path: &Path, config: RunConfig, names: [String; 3], lines: &[ScoreLine]) -> Self {
        let [agent, variant, called] = names;
        let experiment = &config.experiment;
        let mut by_step: BTreeMap<u64, BTreeMap<u64, &ScoreLine>> = BTreeMap::new();
        for line in lines {
            by_step.entry(line.step).or_default().insert(line.seed, line);
        }
        let (schedule, episodes) = (experiment.schedule(), u64::from(experiment.episodes));
        let planned = by_step.iter().filter(|(step, _)| schedule.is_evaluated(**step));
        let scored: u64 = planned.map(|(_, scored)| episodes.min(scored.len() as u64)).sum();
        let episodes_missing =
            schedule.evaluations().saturating_mul(episodes).saturating_sub(scored);
        let evaluations: Vec<_> = by_step
            .into_iter()
            .filter_map(|(step, episodes)| {
                EvaluationReport::of(
                    step,
                    &Vec::from_iter(episodes.into_values()),
                    experiment.episodes,
                )
            })
            .collect();
        let complete: Vec<_> =
            evaluations.iter().filter(|e| e.complete).map(|e| (e.step, e.score.mean)).collect();
        let mean = |evaluations: &[(u64, f64)]| {
            let scores: Vec<_> = evaluations.iter().map(|(_, score)| *score).collect();
            Spread::of(&scores).map(|spread| spread.mean)
        };
        let last = |count: usize| mean(&complete[complete.len().checked_sub(count)?..]);
        let final_steps = experiment.steps.checked_sub(FINAL_STEPS).filter(|start| *start > 0);
        let in_final_steps =
            |start| mean(&complete[complete.partition_point(|(step, _)| *step <= start)..]);
        let normalized = environment::find(&experiment.environment).is_ok();
        let precisions: BTreeSet<String> = lines.iter().map(precision).collect();
        Self {
            dir: path.to_owned(),
            run: config.run.name.to_string(),
            task: config.run.task.clone(),
            algorithm: experiment.algorithm.clone(),
            variant,
            agent,
            seed: experiment.seed,
            steps: experiment.steps,
            normalized,
            own_score: !normalized && lines.iter().any(|line| line.score != line.episode_return),
            scored_in: joined(&precisions),
            dataset_score: config.dataset.mean_score.unwrap_or(config.dataset.mean_return),
            mean_last_3: last(3),
            mean_last_5: last(5),
            mean_last_50000_steps: final_steps.and_then(in_final_steps),
            evaluations,
            episodes_missing,
            summary: None,
            judgments: Vec::new(),
            called,
            precisions,
            config,
        }
    }

    /// Mean score of as many of the last complete evaluations as its task's published figures are
    /// of; absent if they are fewer.
    pub fn score(&self) -> Option<f64> {
        if published::last(&self.task) == 3 { self.mean_last_3 } else { self.mean_last_5 }
    }

    /// Whether every episode of every evaluation has its score.
    pub fn is_complete(&self) -> bool {
        self.episodes_missing == 0
    }

    /// Its complete evaluation with the largest score.
    pub fn best(&self) -> Option<&EvaluationReport> {
        self.best_of(|_| true)
    }

    /// The best among the evaluations of some steps; of equal ones the last.
    pub fn best_of(&self, is_one: impl Fn(u64) -> bool) -> Option<&EvaluationReport> {
        let complete = self
            .evaluations
            .iter()
            .filter(|evaluation| evaluation.complete && is_one(evaluation.step));
        complete.max_by(|one, other| one.score.mean.total_cmp(&other.score.mean))
    }

    /// Its last complete evaluation.
    pub fn newest(&self) -> Option<&EvaluationReport> {
        self.evaluations.iter().rfind(|evaluation| evaluation.complete)
    }

    /// How many of the planned evaluations have all their scores.
    pub fn evaluations_complete(&self) -> usize {
        let schedule = self.config.experiment.schedule();
        self.evaluations
            .iter()
            .filter(|evaluation| evaluation.complete && schedule.is_evaluated(evaluation.step))
            .count()
    }

    /// The step of the last complete evaluation of a run that is not complete.
    pub fn reached(&self) -> Option<u64> {
        (!self.is_complete()).then_some(self.newest().map_or(0, |evaluation| evaluation.step))
    }

    /// How far a run has come that is not complete, in words.
    pub fn how_complete(&self) -> String {
        format!(
            "{} of {} evaluations are complete, the last of them after {} of {} steps",
            self.evaluations_complete(),
            self.config.experiment.schedule().evaluations(),
            self.reached().unwrap_or(self.steps),
            self.steps
        )
    }

    /// What its scores are: scores of a kind, or returns.
    pub fn measure(&self) -> &'static str {
        if self.normalized || self.own_score { "score" } else { "return" }
    }

    /// [`Self::measure`] with its unit: in a maze, the share of episodes that reach the goal.
    pub fn measure_with_unit(&self) -> &'static str {
        match environment::find(&self.config.experiment.environment) {
            Ok(known) if known.goal.is_some() => "success rate in %",
            Ok(_) => "D4RL-normalized score",
            Err(_) => self.measure(),
        }
    }

    /// The evaluations as a table for people.
    pub fn table(&self) -> String {
        let mut header = vec!["step", "episodes", self.measure(), "length"];
        // Without reference returns the score is the return, unless the user counts something else.
        let has_both = self.measure() == "score";
        if has_both {
            header.insert(3, "return");
        }
        let mut table = Table::new(&Vec::from_iter(header.into_iter().map(|name| (name, Right))));
        for e in &self.evaluations {
            let episodes = e.episodes.to_string() + if e.complete { "" } else { " (part)" };
            let mut row =
                vec![e.step.to_string(), episodes, e.score.text(), format!("{:.1}", e.mean_length)];
            if has_both {
                row.insert(3, format!("{:.1}", e.mean_return));
            }
            table.push(row);
        }
        let mut text = format!(
            "{}: task {}, {}, {} steps, seed {}; {}, scored in {}\n\n",
            self.run,
            self.task,
            self.agent,
            self.steps,
            self.seed,
            self.measure_with_unit(),
            self.scored_in
        ) + &table.render(Style::Text);
        if self.evaluations.is_empty() {
            text.push_str("(no evaluation has a score yet)\n");
        }
        // Writing to a string cannot fail.
        if !self.is_complete() {
            writeln!(
                text,
                "{} episodes have no score: {}",
                self.episodes_missing,
                self.how_complete()
            )
            .ok();
        }
        text.push('\n');
        for (name, mean) in [
            ("last 3 evaluations:", self.mean_last_3),
            ("last 5 evaluations:", self.mean_last_5),
            ("last 50000 steps:", self.mean_last_50000_steps),
            ("dataset:", (!self.own_score).then_some(self.dataset_score)),
        ] {
            if let Some(mean) = mean {
                writeln!(text, "mean {} of the {name:19} {mean:.2}", self.measure()).ok();
            }
        }
        text + &self
            .summary
            .as_ref()
            .map(|summary| format!("\n{}", summary.text))
            .unwrap_or_default()
    }
}

/// The precision of a score, whatever instructions it was computed by.
fn precision(line: &ScoreLine) -> String {
    match line.precision.split('-').next() {
        None | Some("") => "unknown".to_owned(),
        Some(precision) => precision.to_owned(),
    }
}

/// `bf16 and f32`; a dash of none.
pub fn joined<'a>(precisions: impl IntoIterator<Item = &'a String>) -> String {
    let precisions: BTreeSet<&str> = precisions.into_iter().map(String::as_str).collect();
    if precisions.is_empty() { "-".to_owned() } else { Vec::from_iter(precisions).join(" and ") }
}
