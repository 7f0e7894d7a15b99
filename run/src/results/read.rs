//! Reads a run's folder and summarizes its scores.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use quad_dataset::environment;

use super::judgment::Judgment;
use super::report::{EvaluationReport, RunReport};
use super::statistics::Spread;
use crate::config::{ConfigError, RunConfig};
use crate::folder::error::content;
use crate::folder::{RunDir, RunDirError, ScoreLine, read_metrics};

/// Gradient steps at the end of a run that the paper's appendix B averages.
const FINAL_STEPS: u64 = 50_000;

impl RunReport {
    /// Reads a run folder.
    pub fn read(path: &Path) -> Result<Self, RunDirError> {
        let mut report = Self::scored(path)?;
        let definition = report.config.experiment.definition();
        if let Some(summary) = definition.map_err(unusable(path))?.summary {
            report.summary = summary(&read_metrics(path)?, &report.variant);
        }
        Ok(report)
    }

    /// Reads a run folder without `metrics.jsonl`, so that the report has no summary.
    pub fn scored(path: &Path) -> Result<Self, RunDirError> {
        Ok(Self::with_scores(path)?.0)
    }

    /// Reads as [`scored`](Self::scored); also returns the episodes' scores.
    pub fn with_scores(path: &Path) -> Result<(Self, Vec<ScoreLine>), RunDirError> {
        let (dir, config) = RunDir::open(path)?;
        let (scores, judgments) = (dir.read_scores()?, Judgment::read_all(&dir)?);
        let mut report = Self::new(path, config, &scores).map_err(unusable(path))?;
        report.judgments = judgments;
        Ok((report, scores))
    }

    fn new(path: &Path, config: RunConfig, lines: &[ScoreLine]) -> Result<Self, ConfigError> {
        let experiment = &config.experiment;
        let mut by_step: BTreeMap<u64, BTreeMap<u64, &ScoreLine>> = BTreeMap::new();
        for line in lines {
            by_step.entry(line.step).or_default().insert(line.seed, line);
        }
        let (schedule, episodes) = (experiment.schedule(), u64::from(experiment.episodes));
        let planned = by_step.iter().filter(|(step, _)| schedule.is_evaluated(**step));
        let scored: u64 = planned.map(|(_, scored)| episodes.min(scored.len() as u64)).sum();
        let expected = schedule.evaluations().saturating_mul(episodes);
        let evaluate = |(step, episodes): (u64, BTreeMap<u64, &ScoreLine>)| {
            let episodes = Vec::from_iter(episodes.into_values());
            EvaluationReport::new(step, &episodes, experiment)
        };
        let evaluations: Vec<_> = by_step.into_iter().filter_map(evaluate).collect();
        let counted = Vec::from_iter(evaluations.iter().filter(|evaluation| evaluation.counts()));
        let mean = |evaluations: &[&EvaluationReport]| {
            let scores = Vec::from_iter(evaluations.iter().map(|e| e.score.mean));
            Spread::new(&scores).map(|spread| spread.mean)
        };
        let last = |count: usize| mean(&counted[counted.len().checked_sub(count)?..]);
        let begins = experiment.online_begins().unwrap_or(0);
        let final_steps =
            experiment.total_steps().checked_sub(FINAL_STEPS).filter(|start| *start > begins);
        let in_final_steps = |start| {
            mean(&counted[counted.partition_point(|evaluation| evaluation.step <= start)..])
        };
        let normalized = environment::find(&experiment.environment).is_ok();
        let precisions: BTreeSet<String> = lines.iter().map(precision).collect();
        let dataset_score = config.dataset.mean_score.unwrap_or(config.dataset.mean_return);
        Ok(Self {
            dir: path.to_owned(),
            run: config.run.name.to_string(),
            task: config.run.task.clone(),
            algorithm: experiment.algorithm.clone(),
            variant: experiment.variant()?.to_owned(),
            agent: experiment.method()?,
            seed: experiment.seed,
            steps: experiment.total_steps(),
            normalized,
            own_score: !normalized && lines.iter().any(|line| line.score != line.episode_return),
            scored_in: joined(&precisions),
            dataset_score: Some(dataset_score).filter(|score| !score.is_nan()),
            mean_last_3: last(3),
            mean_last_5: last(5),
            mean_last_50000_steps: final_steps.and_then(in_final_steps),
            evaluations,
            episodes_missing: expected.saturating_sub(scored),
            summary: None,
            judgments: Vec::new(),
            label: experiment.label()?,
            precisions,
            config,
        })
    }
}

fn unusable(path: &Path) -> impl FnOnce(ConfigError) -> RunDirError {
    let config = path.join("config.toml");
    move |error| content(&config, None, error)
}

/// The precision of a score, without its instructions.
fn precision(line: &ScoreLine) -> String {
    match line.precision.split('-').next() {
        None | Some("") => "unknown".to_owned(),
        Some(precision) => precision.to_owned(),
    }
}

/// Lists precisions: `bf16 and f32`; without any, `-`.
pub fn joined<'a>(precisions: impl IntoIterator<Item = &'a String>) -> String {
    let precisions = BTreeSet::from_iter(precisions.into_iter().map(String::as_str));
    match precisions.is_empty() {
        true => "-".to_owned(),
        false => Vec::from_iter(precisions).join(" and "),
    }
}
