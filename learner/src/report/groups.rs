//! Groups of runs that differ only in their seed, and the tasks by which groups are compared.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use quad_dataset::{DatasetFile, GoalDraw, environment};
use quad_run::config::settings::{self, Settings, differences_in_brief};
use quad_run::config::{Device, RunConfig};
use quad_run::counted;
use quad_run::results::departures::{as_given, departures};
use quad_run::results::published::{self, Published};
use quad_run::results::{RunReport, Select, Spread, joined};
use serde::Serialize;

/// Runs that agree in task, data, device, all hyper-parameters and progress. The precision of their
/// scores may differ.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GroupReport {
    /// Unlike for unlike environments or data.
    pub task: String,
    /// The task after `--task`.
    #[serde(skip)]
    pub named: String,
    pub algorithm: String,
    /// The kind of guidance for QUAD, such as `quad`, `dac` and `none`, or another algorithm's
    /// name.
    pub variant: String,
    /// Name in tables and figures: the variant, and settings that are not the task's own if other
    /// runs of the variant have other values.
    pub method: String,
    /// The most important hyper-parameters.
    pub agent: String,
    /// Planned gradient steps.
    pub steps: u64,
    /// Step of the last complete evaluation, if the runs are not complete.
    pub reached: Option<u64>,
    pub device: Device,
    /// False if scores are returns: the environment has no reference returns.
    pub normalized: bool,
    pub scored_in: String,
    /// One seed for each counted run.
    pub seeds: Vec<u64>,
    /// The score of each seed; empty if the runs are not complete, or have too few evaluations.
    pub scores: Vec<f64>,
    #[serde(skip)]
    pub runs: Vec<RunReport>,
    /// The folders of all runs, counted or not.
    #[serde(skip)]
    pub dirs: Vec<PathBuf>,
    /// Number of goals, in an environment that draws one for a whole run.
    pub goals: Option<usize>,
    pub mean_last_3: Option<Spread>,
    pub mean_last_5: Option<Spread>,
    pub mean_last_50000_steps: Option<Spread>,
    /// The best evaluation of each run; only with `--select best`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub best: Option<Spread>,
    /// Runs with missing evaluations, and their number.
    pub unfinished: Vec<String>,
    /// Runs that are not counted, and why.
    pub left_out: Vec<String>,
    /// The settings in which other runs of the task and algorithm differ.
    pub differs: Vec<String>,
    /// Departures from the authors' protocol; empty without published scores of the task.
    pub departures: Vec<String>,
    pub published: Vec<Published>,
}

impl GroupReport {
    /// `4 seeds, 2000000 steps on cpu, scored in f32`.
    pub fn provenance(&self) -> String {
        let (seeds, scored_in) = (counted(self.seeds.len(), "seed"), &self.scored_in);
        let goals = self.goals.map_or("", |_| " with a goal each");
        let (steps, device) = (self.steps_in_words(), self.device.name());
        format!("{seeds}{goals}, {steps} on {device}, scored in {scored_in}")
    }

    pub fn measure(&self) -> &'static str {
        let first = self.runs.first();
        first.map_or("return", RunReport::measure_with_unit)
    }

    pub fn by_seed(&self) -> impl Iterator<Item = (&u64, &f64)> {
        self.seeds.iter().zip(&self.scores)
    }

    pub fn steps_in_words(&self) -> String {
        match self.reached {
            Some(step) => format!("{step} of {} steps (not complete)", self.steps),
            None => format!("{} steps", self.steps),
        }
    }
}

struct Group<'a> {
    variant: [&'a str; 2],
    /// Without the seed.
    settings: Settings,
    /// The task's own values for the variant; empty if the task is unknown.
    preset: Settings,
    runs: Vec<&'a RunReport>,
}

impl Group<'_> {
    fn task(&self) -> &str {
        &self.runs[0].task
    }

    fn is_preset(&self, key: &str) -> bool {
        let is_task = key == "environment" || key.starts_with("dataset.");
        is_task || !self.preset.is_empty() && self.preset.get(key) == self.settings.get(key)
    }

    fn setting(&self, key: &str) -> String {
        let value = self.settings.get(key);
        value.map_or_else(|| format!("no {key}"), |value| format!("{key} = {value}"))
    }

    /// True if the run differs from these only in its seed.
    fn fits(&self, run: &RunReport, settings: &Settings) -> bool {
        let progress_fits = self.runs[0].reached() == run.reached() || run.reached() == Some(0);
        self.task() == run.task && self.settings == *settings && progress_fits
    }
}

/// All settings but the seed, and of the checkpoint of `--from` only that there is one: the runs that
/// others go on from differ in their seeds, too.
pub fn seedless(config: &RunConfig) -> Settings {
    let mut settings = settings::from_run(config);
    settings.remove("seed");
    settings.entry("from".to_owned()).and_modify(|hash| *hash = "a run".to_owned());
    settings
}

/// Groups runs, in the order in which they are given, but those without scores last: they join
/// others.
pub fn groups(runs: &[RunReport], select: Select) -> Vec<GroupReport> {
    let mut groups: Vec<Group> = Vec::new();
    let (scored, unscored): (Vec<_>, Vec<_>) =
        runs.iter().partition(|run| run.reached() != Some(0));
    for run in scored.into_iter().chain(unscored) {
        let settings = seedless(&run.config);
        if let Some(group) = groups.iter_mut().find(|group| group.fits(run, &settings)) {
            group.runs.push(run);
            continue;
        }
        let preset = as_given(run, true).map(|given| settings::from_experiment(&given));
        groups.push(Group {
            variant: [&run.algorithm, &run.variant],
            settings,
            preset: preset.unwrap_or_default(),
            runs: vec![run],
        });
    }
    let mut reports = Vec::new();
    for group in &groups {
        let (mut differs, mut names) = (BTreeSet::new(), BTreeSet::new());
        for other in &groups {
            let is_same_task = other.task() == group.task();
            let keys = Vec::from_iter(differences_in_brief(&group.settings, &other.settings));
            if is_same_task && other.variant[0] == group.variant[0] {
                differs.extend(keys.clone());
            }
            // Two tasks may have values of their own; any other value makes another method.
            let is_own = |key| !is_same_task && group.is_preset(key) && other.is_preset(key);
            if other.variant == group.variant {
                names.extend(keys.into_iter().filter(|key| !is_own(key)));
            }
        }
        let mut method = vec![group.runs[0].label.clone()];
        names.retain(|key| group.preset.get(*key) != group.settings.get(*key));
        method.extend(names.into_iter().map(|key| group.setting(key)));
        let differs = differs.into_iter().map(|key| group.setting(key)).collect();
        reports.push(report(&group.runs, method.join(", "), differs, select));
    }
    reports
}

/// The runs that count, and why others do not.
fn that_count<'a>(runs: &[&'a RunReport]) -> (Vec<&'a RunReport>, Vec<String>) {
    let (mut counted, mut left_out) = (Vec::<&RunReport>::new(), Vec::new());
    for run in runs.iter().copied() {
        let (dir, seed) = (run.dir.display(), run.seed);
        if run.newest().is_none() {
            left_out.push(format!("{dir} has no complete evaluation"));
        } else if let Some(first) = counted.iter().find(|other| other.seed == seed) {
            let first = first.dir.display();
            left_out.push(format!("{dir} has seed {seed} again; only {first} is counted"));
        } else {
            counted.push(run);
        }
    }
    (counted, left_out)
}

fn report(
    runs: &[&RunReport],
    method: String,
    differs: Vec<String>,
    select: Select,
) -> GroupReport {
    let (counted, left_out) = that_count(runs);
    let values = |value: fn(&RunReport) -> Option<f64>| -> Option<Vec<f64>> {
        counted.iter().map(|run| value(run)).collect()
    };
    let spread = |value| Spread::new(&values(value)?);
    let best = |run: &RunReport| run.best().map(|best| best.score.mean);
    let scores = match select {
        Select::Last => values(RunReport::score),
        Select::Best => values(best),
    };
    let first = runs[0];
    let scored_in = joined(counted.iter().flat_map(|run| &run.precisions));
    let published = published::scores(&first.config.run.task);
    let environment = environment::find(&first.config.experiment.environment);
    let maze = environment.ok().and_then(|spec| spec.maze);
    let has_one_goal = maze.is_some_and(|maze| maze.draw == GoalDraw::EachInstance);
    let mut unfinished = Vec::new();
    for run in counted.iter().filter(|run| !run.is_complete()) {
        unfinished.push(format!("in {} {}", run.dir.display(), run.how_complete()));
    }
    let departures = match published.is_empty() {
        true => Vec::new(),
        false => departures(&counted, &scored_in, select),
    };
    GroupReport {
        task: first.task.clone(),
        named: first.config.run.task.clone(),
        algorithm: first.algorithm.clone(),
        variant: first.variant.clone(),
        method,
        agent: first.agent.clone(),
        steps: first.steps,
        reached: first.reached(),
        device: first.config.run.device,
        normalized: first.normalized,
        seeds: counted.iter().map(|run| run.seed).collect(),
        scores: scores.filter(|_| first.is_complete()).unwrap_or_default(),
        goals: has_one_goal.then_some(counted.len()),
        mean_last_3: spread(|run| run.mean_last_3),
        mean_last_5: spread(|run| run.mean_last_5),
        mean_last_50000_steps: spread(|run| run.mean_last_50000_steps),
        best: spread(best).filter(|_| select == Select::Best),
        unfinished,
        left_out,
        differs,
        dirs: runs.iter().map(|run| run.dir.clone()).collect(),
        departures,
        runs: counted.into_iter().cloned().collect(),
        scored_in,
        published,
    }
}

/// Adds environment and data to the names of tasks that have several of them in these runs, such as
/// `own-data` of two robots.
pub fn tell_apart(runs: &mut [RunReport]) {
    let mut settings: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for run in &*runs {
        settings.entry(run.task.clone()).or_default().insert(setting(run));
    }
    for run in runs.iter_mut().filter(|run| settings[&run.task].len() > 1) {
        run.task = format!("{} ({})", run.task, setting(run));
    }
}

/// The environment and the beginning of each file's SHA-256, which older runs lack.
fn setting(run: &RunReport) -> String {
    let begin = |file: &DatasetFile| format!("{:.8}", file.sha256.as_deref().unwrap_or("unknown"));
    if run.config.dataset.files.is_empty() {
        return format!("{}, no data", run.config.experiment.environment);
    }
    let hashes = Vec::from_iter(run.config.dataset.files.iter().map(begin)).join("+");
    format!("{}, data {hashes}", run.config.experiment.environment)
}
