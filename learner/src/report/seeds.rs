//! Runs that are alike but for their seed, and what becomes of those that are not.

use std::collections::BTreeSet;

use quad_dataset::catalogue::{self, Checksum};
use serde::Serialize;

use super::Spread;
use super::published::{self, Published};
use super::run::RunReport;
use crate::config::device::Device;
use crate::config::{self, Experiment};
use crate::settings::{self, Settings, differences};

/// Runs that differ in their seed alone: in preset, data, device, precision and every hyper-parameter they agree.
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
    /// Where they trained.
    pub device: Device,
    /// Whether scores are D4RL-normalised; without reference returns they are returns.
    pub normalised: bool,
    /// Arithmetic that the policies were scored in.
    pub scored_in: String,
    /// The seeds, one for each run that is counted.
    pub seeds: Vec<u64>,
    /// `mean_last_3` over the runs; absent if one of them has none.
    pub mean_last_3: Option<Spread>,
    /// The same of `mean_last_5`.
    pub mean_last_5: Option<Spread>,
    /// The same of `mean_last_50000_steps`.
    pub mean_last_50000_steps: Option<Spread>,
    /// Runs that are not counted, each with the reason.
    pub left_out: Vec<String>,
    /// The settings in which other runs of the preset differ from these.
    pub differs: Vec<String>,
    /// How these runs depart from the paper's protocol; empty for a preset that is no task of the paper.
    pub departures: Vec<String>,
    /// What is published for the task.
    pub published: Vec<Published>,
}

/// Sorts runs into groups, in the order in which they are given.
pub(super) fn groups(runs: &[RunReport]) -> Vec<GroupReport> {
    let mut groups: Vec<(Settings, Vec<&RunReport>)> = Vec::new();
    for run in runs {
        let settings = settings(run);
        match groups.iter_mut().find(|(known, members)| members[0].preset == run.preset && *known == settings) {
            Some((_, members)) => members.push(run),
            None => groups.push((settings, vec![run])),
        }
    }
    let differs = |index: usize| {
        let (own, members) = &groups[index];
        let siblings = groups.iter().filter(|(_, others)| others[0].preset == members[0].preset);
        let keys: BTreeSet<&String> = siblings.flat_map(|(other, _)| differences(own, other)).collect();
        let value = |key: &String| own.get(key).map_or_else(|| format!("no {key}"), |value| format!("{key} = {value}"));
        keys.into_iter().map(value).collect()
    };
    groups.iter().enumerate().map(|(index, (_, runs))| group(runs, differs(index))).collect()
}

fn group(runs: &[&RunReport], differs: Vec<String>) -> GroupReport {
    let mut counted: Vec<&RunReport> = Vec::new();
    let mut left_out = Vec::new();
    for run in runs {
        let dir = run.dir.display();
        if !run.evaluations.iter().any(|evaluation| evaluation.complete) {
            left_out.push(format!("{dir} has no complete evaluation"));
        } else if let Some(first) = counted.iter().find(|other| other.seed == run.seed) {
            left_out.push(format!("{dir} has seed {} like {}, which is counted", run.seed, first.dir.display()));
        } else {
            counted.push(run);
        }
    }
    let over = |value: fn(&RunReport) -> Option<f64>| {
        let values: Option<Vec<_>> = counted.iter().map(|run| value(run)).collect();
        Spread::of(&values?)
    };
    let first = runs[0];
    let published = published::scores(&first.preset);
    GroupReport {
        preset: first.preset.clone(),
        variant: first.variant.clone(),
        agent: first.agent.clone(),
        candidates: first.candidates,
        steps: first.steps,
        device: first.config.run.device,
        normalised: first.normalised,
        scored_in: first.scored_in.clone(),
        seeds: counted.iter().map(|run| run.seed).collect(),
        mean_last_3: over(|run| run.mean_last_3),
        mean_last_5: over(|run| run.mean_last_5),
        mean_last_50000_steps: over(|run| run.mean_last_50000_steps),
        left_out,
        differs,
        departures: if published.is_empty() { Vec::new() } else { departures(first, &counted) },
        published,
    }
}

/// Everything that runs must share to be averaged over their seeds.
fn settings(run: &RunReport) -> Settings {
    let mut settings = settings::of_run(&run.config);
    settings.remove("seed");
    settings.insert("scored in".to_owned(), run.scored_in.clone());
    settings
}

fn experiment(experiment: &Experiment) -> Settings {
    let mut settings = settings::of_experiment(experiment);
    settings.remove("seed");
    settings
}

/// Whether a run learnt from the dataset of that name, whatever it was called on the command line.
fn is_trained_on(run: &RunReport, dataset: Option<&str>) -> bool {
    let known = dataset.and_then(catalogue::find).filter(|known| known.sha256 != Checksum::default());
    let same_file =
        run.config.dataset.sha256.as_ref().zip(known).is_some_and(|(sha256, known)| known.sha256.matches(sha256));
    same_file || run.config.experiment.dataset.as_deref() == dataset
}

/// In which ways runs of one of the paper's presets are not what the paper ran.
fn departures(run: &RunReport, counted: &[&RunReport]) -> Vec<String> {
    let Ok(paper) = config::resolve(&run.preset, &toml::Table::new()) else { return Vec::new() };
    let mut departures = Vec::new();
    let ours = &run.config.experiment;
    if !is_trained_on(run, paper.dataset.as_deref()) {
        let name = |dataset: &Option<String>| dataset.clone().unwrap_or_else(|| "not named".to_owned());
        departures.push(format!("dataset is {}, not {}", name(&ours.dataset), name(&paper.dataset)));
    }
    let (ours, paper) = (experiment(ours), experiment(&paper));
    let keys: BTreeSet<&String> = differences(&ours, &paper).collect();
    for key in keys {
        let value = |settings: &Settings| settings.get(key).cloned().unwrap_or_else(|| "absent".to_owned());
        departures.push(format!("{key} is {}, not {}", value(&ours), value(&paper)));
    }
    let planned = run.steps.checked_div(run.config.experiment.eval_interval).unwrap_or(0);
    let complete = |run: &&RunReport| run.evaluations.iter().filter(|e| e.complete).count() as u64;
    if let Some(fewest) = counted.iter().map(complete).min().filter(|fewest| *fewest < planned) {
        departures.push(format!("{fewest} of {planned} evaluations are complete"));
    }
    if counted.len() < published::SEEDS {
        departures.push(format!("{} of {} seeds", counted.len(), published::SEEDS));
    }
    departures
}
