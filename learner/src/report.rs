//! What a run achieved: a summary of its evaluations, and of several runs over their seeds.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::algorithms::Hyperparameters;
use crate::config::{DatasetInfo, Experiment, RunConfig};
use crate::device::Device;
use crate::run_dir::{RunDir, RunDirError, ScoreLine};

/// Mean and sample standard deviation (n - 1).
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// The mean.
    pub mean: f64,
    /// The standard deviation; absent for a single value.
    pub std: Option<f64>,
}

impl Spread {
    /// Of some values; absent without any.
    pub fn of(values: &[f64]) -> Option<Self> {
        let count = values.len() as f64;
        if values.is_empty() {
            return None;
        }
        let mean = values.iter().sum::<f64>() / count;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let std = (values.len() > 1).then(|| (squares / (count - 1.0)).sqrt());
        Some(Self { mean, std })
    }
}

/// One snapshot's episodes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EvaluationReport {
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Episodes scored.
    pub episodes: usize,
    /// Whether these are all of them.
    pub complete: bool,
    /// D4RL-normalised score over the episodes.
    pub score: Spread,
    /// Mean undiscounted return.
    pub mean_return: f64,
    /// Mean length in environment steps.
    pub mean_length: f64,
}

/// One run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RunReport {
    /// Its folder.
    pub dir: PathBuf,
    /// Its name.
    pub run: String,
    /// The preset it started from.
    pub preset: String,
    /// The variant of the algorithm: `quad`, `dac` or `none` for QUAD's kinds of guidance, or another algorithm's name.
    pub variant: String,
    /// The hyper-parameters that matter most.
    pub agent: String,
    /// Actions sampled per state in an evaluation.
    pub candidates: u32,
    /// Seed.
    pub seed: u64,
    /// Gradient steps.
    pub steps: u64,
    /// Mean normalised score of the dataset's trajectories; without reference returns, their mean return.
    pub dataset_score: f64,
    /// Its evaluations by step.
    pub evaluations: Vec<EvaluationReport>,
    /// Mean score of the last 3 complete evaluations; absent if they are fewer.
    pub mean_last_3: Option<f64>,
    /// The same of the last 5.
    pub mean_last_5: Option<f64>,
    #[serde(skip)]
    alike: Alike,
}

/// What runs must have in common to be averaged over their seeds.
#[derive(Clone, Debug, PartialEq)]
struct Alike {
    preset: String,
    device: Device,
    dataset: DatasetInfo,
    /// With its seed left out.
    experiment: Experiment,
}

/// Runs that differ in their seed alone: in preset, dataset, device and every hyper-parameter they agree.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GroupReport {
    /// The preset.
    pub preset: String,
    /// The variant of the algorithm: `quad`, `dac` or `none` for QUAD's kinds of guidance, or another algorithm's name.
    pub variant: String,
    /// The hyper-parameters that matter most.
    pub agent: String,
    /// Actions sampled per state in an evaluation.
    pub candidates: u32,
    /// Gradient steps.
    pub steps: u64,
    /// The seeds, one for each run that has an evaluation.
    pub seeds: Vec<u64>,
    /// `mean_last_3` over the runs.
    pub mean_last_3: Option<Spread>,
    /// `mean_last_5` over the runs.
    pub mean_last_5: Option<Spread>,
}

/// What `learner report` says.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Each folder.
    pub runs: Vec<RunReport>,
    /// The folders summarised over seeds.
    pub groups: Vec<GroupReport>,
}

impl RunReport {
    /// Reads a run folder.
    pub fn read(path: &Path) -> Result<Self, RunDirError> {
        let (dir, config) = RunDir::open(path)?;
        let unusable = |error: crate::config::ConfigError| RunDirError::Content {
            path: path.join("config.toml"),
            line: None,
            reason: error.to_string(),
        };
        let agent = config.experiment.hyperparameters().map_err(unusable)?;
        Ok(Self::new(path, config, &*agent, &dir.read_scores()?))
    }

    fn new(path: &Path, config: RunConfig, agent: &dyn Hyperparameters, lines: &[ScoreLine]) -> Self {
        let experiment = &config.experiment;
        let mut by_step: BTreeMap<u64, BTreeMap<u64, &ScoreLine>> = BTreeMap::new();
        for line in lines {
            by_step.entry(line.step).or_default().insert(line.seed, line);
        }
        let evaluations: Vec<_> = by_step
            .into_iter()
            .filter_map(|(step, episodes)| {
                evaluation(step, &Vec::from_iter(episodes.into_values()), experiment.episodes)
            })
            .collect();
        let complete: Vec<_> = evaluations.iter().filter(|e| e.complete).map(|e| e.score.mean).collect();
        let last = |count: usize| Spread::of(&complete[complete.len().checked_sub(count)?..]).map(|spread| spread.mean);
        let (mean_last_3, mean_last_5) = (last(3), last(5));
        Self {
            dir: path.to_owned(),
            run: config.run.name.clone(),
            preset: config.run.preset.clone(),
            variant: agent.variant(),
            agent: agent.summary(),
            candidates: experiment.candidates,
            seed: experiment.seed,
            steps: experiment.steps,
            dataset_score: config.dataset.mean_score.unwrap_or(config.dataset.mean_return),
            evaluations,
            mean_last_3,
            mean_last_5,
            alike: Alike {
                preset: config.run.preset,
                device: config.run.device,
                dataset: config.dataset,
                experiment: Experiment { seed: 0, ..config.experiment },
            },
        }
    }

    /// The evaluations as a table for people.
    pub fn table(&self) -> String {
        let mut text = format!(
            "{}: preset {}, {}, {} candidates, {} steps, seed {}\n\n",
            self.run, self.preset, self.agent, self.candidates, self.steps, self.seed
        );
        let mut line = |arguments: std::fmt::Arguments<'_>| {
            // Writing to a string cannot fail.
            writeln!(text, "{arguments}").ok();
        };
        line(format_args!("{:>10}  {:>8}  {:>17}  {:>8}  {:>8}", "step", "episodes", "score", "return", "length"));
        for e in &self.evaluations {
            let episodes = if e.complete { e.episodes.to_string() } else { format!("{} (part)", e.episodes) };
            let (score, mean_return) = (spread(e.score), e.mean_return);
            line(format_args!(
                "{:>10}  {episodes:>8}  {score:>17}  {mean_return:>8.1}  {:>8.1}",
                e.step, e.mean_length
            ));
        }
        if self.evaluations.is_empty() {
            line(format_args!("{:>10}", "(no evaluation has a score yet)"));
        }
        line(format_args!(""));
        for (name, mean) in [("last 3", self.mean_last_3), ("last 5", self.mean_last_5)] {
            if let Some(mean) = mean {
                line(format_args!("mean score of the {name} evaluations: {mean:.2}"));
            }
        }
        line(format_args!("mean score of the dataset:            {:.2}", self.dataset_score));
        text
    }
}

fn evaluation(step: u64, episodes: &[&ScoreLine], expected: u32) -> Option<EvaluationReport> {
    let mean =
        |value: fn(&ScoreLine) -> f64| episodes.iter().map(|line| value(line)).sum::<f64>() / episodes.len() as f64;
    let scores: Vec<_> = episodes.iter().map(|line| line.score).collect();
    Some(EvaluationReport {
        step,
        episodes: episodes.len(),
        complete: episodes.len() == expected as usize,
        score: Spread::of(&scores)?,
        mean_return: mean(|line| line.episode_return),
        mean_length: mean(|line| line.length.into()),
    })
}

impl Report {
    /// Reads run folders.
    pub fn read(paths: &[PathBuf]) -> Result<Self, RunDirError> {
        let runs: Vec<_> = paths.iter().map(|path| RunReport::read(path)).collect::<Result<_, _>>()?;
        Ok(Self { groups: groups(&runs), runs })
    }

    /// A table of each run; with several runs also the summary over seeds.
    pub fn table(&self) -> String {
        let mut text = String::new();
        for run in &self.runs {
            text.push_str(&run.table());
            text.push('\n');
        }
        if self.runs.len() > 1 {
            text.push_str(&self.summary());
        }
        text
    }

    fn summary(&self) -> String {
        let mut text = String::from("Over seeds (mean ± standard deviation of the runs):\n\n");
        let header = ["preset", "algorithm", "candidates", "steps", "runs", "last 3", "last 5"].map(str::to_owned);
        let cell = |value: Option<Spread>| value.map_or_else(|| "-".to_owned(), spread);
        let rows = self.groups.iter().map(|g| {
            let (candidates, steps, runs) = (g.candidates.to_string(), g.steps.to_string(), g.seeds.len().to_string());
            let (last_3, last_5) = (cell(g.mean_last_3), cell(g.mean_last_5));
            [g.preset.clone(), g.agent.clone(), candidates, steps, runs, last_3, last_5]
        });
        let rows: Vec<_> = std::iter::once(header).chain(rows).collect();
        let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
        let widths: [usize; 7] = std::array::from_fn(width);
        for row in &rows {
            let cells = row.iter().zip(widths).map(|(cell, width)| format!("{cell:>width$}"));
            text.push_str(&cells.collect::<Vec<_>>().join("  "));
            text.push('\n');
        }
        text
    }
}

fn groups(runs: &[RunReport]) -> Vec<GroupReport> {
    let mut members: Vec<Vec<&RunReport>> = Vec::new();
    for run in runs {
        match members.iter_mut().find(|group| group[0].alike == run.alike) {
            Some(group) => group.push(run),
            None => members.push(vec![run]),
        }
    }
    let group = |runs: Vec<&RunReport>| {
        let scored = || runs.iter().filter(|run| run.mean_last_3.is_some());
        let over = |value: fn(&RunReport) -> Option<f64>| {
            Spread::of(&scored().filter_map(|run| value(run)).collect::<Vec<_>>())
        };
        GroupReport {
            preset: runs[0].preset.clone(),
            variant: runs[0].variant.clone(),
            agent: runs[0].agent.clone(),
            candidates: runs[0].candidates,
            steps: runs[0].steps,
            seeds: scored().map(|run| run.seed).collect(),
            mean_last_3: over(|run| run.mean_last_3),
            mean_last_5: over(|run| run.mean_last_5),
        }
    };
    members.into_iter().map(group).collect()
}

fn spread(Spread { mean, std }: Spread) -> String {
    match std {
        Some(std) => format!("{mean:.2} ± {std:.2}"),
        None => format!("{mean:.2}"),
    }
}
