//! Groups runs that differ only in their seed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use quad_dataset::{Goal, environment};
use quad_run::config::Device;
use quad_run::config::settings::{self, Settings, differences};
use quad_run::results::departures::{as_given, departures};
use quad_run::results::published::{self, Published};
use quad_run::results::{RunReport, joined};
use quad_run::results::{Select, Spread};
use serde::Serialize;

/// Runs that differ in their seed alone: in task, data, device and every hyper-parameter they
/// agree, and in how far they have come. The precision in which evaluators scored them may differ;
/// it is named.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GroupReport {
    /// What they learn.
    pub task: String,
    /// Their algorithm.
    pub algorithm: String,
    /// The variant of the algorithm: the kind of guidance for QUAD, such as `quad`, `dac` and
    /// `none`, or another algorithm's name.
    pub variant: String,
    /// What tables and figures call these runs: the variant and, if other runs of it have another
    /// value of a setting, on whatever task, that setting where it is not the task's own.
    pub method: String,
    /// The hyper-parameters that matter most.
    pub agent: String,
    /// What sources of published figures call this variant of the algorithm, if they have a row of
    /// it.
    pub methods: Vec<&'static str>,
    /// Gradient steps that were asked for.
    pub steps: u64,
    /// Where runs that are not complete have come to: the step of their last complete evaluation.
    pub reached: Option<u64>,
    /// Where they trained.
    pub device: Device,
    /// Whether scores are D4RL-normalized; without reference returns they are returns.
    pub normalized: bool,
    /// Precision that the policies were scored in; several, if evaluators differed.
    pub scored_in: String,
    /// The seeds, one for each run that is counted.
    pub seeds: Vec<u64>,
    /// The score of each of these; empty if they are not complete, or have too few evaluations for
    /// one.
    pub scores: Vec<f64>,
    /// These runs.
    #[serde(skip)]
    pub runs: Vec<RunReport>,
    /// The folders of all runs, counted or not.
    #[serde(skip)]
    pub dirs: Vec<PathBuf>,
    /// Different goals behind the scores, in an environment that draws one for a whole run.
    pub goals: Option<usize>,
    /// `mean_last_3` over the runs; absent if one of them has none.
    pub mean_last_3: Option<Spread>,
    /// `mean_last_5` over the runs; absent if one of them has none.
    pub mean_last_5: Option<Spread>,
    /// `mean_last_50000_steps` over the runs; absent if one of them has none.
    pub mean_last_50000_steps: Option<Spread>,
    /// The score of each run's best evaluation, over the runs; absent unless that is what counts.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub best: Option<Spread>,
    /// Runs whose evaluations are not complete, each with how many there are.
    pub unfinished: Vec<String>,
    /// Runs that are not counted, each with the reason.
    pub left_out: Vec<String>,
    /// The settings in which other runs of the task and algorithm differ from these.
    pub differs: Vec<String>,
    /// How these runs depart from their authors' protocol; empty where nothing is published for the
    /// task.
    pub departures: Vec<String>,
    /// What is published for the task.
    pub published: Vec<Published>,
}

impl GroupReport {
    /// What stands behind the scores, in words.
    pub fn behind(&self) -> String {
        let seeds = self.seeds.len();
        let plural = if seeds == 1 { "" } else { "s" };
        let goals = self.goals.map(|_| " with a goal each").unwrap_or_default();
        let (steps, device, scored_in) =
            (self.steps_in_words(), self.device.name(), &self.scored_in);
        format!("{seeds} seed{plural}{goals}, {steps} on {device}, scored in {scored_in}")
    }

    /// What its numbers are.
    pub fn measure(&self) -> &'static str {
        self.runs.first().map_or("return", RunReport::measure_with_unit)
    }

    /// Each seed with its run's score.
    pub fn by_seed(&self) -> impl Iterator<Item = (&u64, &f64)> {
        self.seeds.iter().zip(&self.scores)
    }

    /// How many gradient steps, and that the runs have not come to the end of them if that is so.
    pub fn steps_in_words(&self) -> String {
        match self.reached {
            Some(step) => format!("{step} of {} steps (not complete)", self.steps),
            None => format!("{} steps", self.steps),
        }
    }
}

/// Runs that agree in all but their seed, and have come as far.
struct Alike<'a> {
    /// Algorithm and variant.
    method: [&'a str; 2],
    /// Without the seed.
    settings: Settings,
    /// The task's own values for the method; none for a task that is not known here.
    given: Settings,
    runs: Vec<&'a RunReport>,
}

impl Alike<'_> {
    /// Whether the value is the task's own, as its environment and data are.
    fn has_own(&self, key: &str) -> bool {
        let is_task = key == "environment" || key.starts_with("dataset.");
        is_task || !self.given.is_empty() && self.given.get(key) == self.settings.get(key)
    }
}

/// Sorts runs into groups, in the order in which they are given.
pub fn groups(runs: &[RunReport], select: Select) -> Vec<GroupReport> {
    let mut groups: Vec<Alike> = Vec::new();
    for run in runs {
        let mut settings = settings::of_run(&run.config);
        settings.remove("seed");
        let is_alike = |Alike { settings: known, runs, .. }: &&mut Alike| {
            let has_come_as_far = runs[0].reached() == run.reached() || run.reached() == Some(0);
            runs[0].task == run.task && *known == settings && has_come_as_far
        };
        match groups.iter_mut().find(is_alike) {
            Some(group) => group.runs.push(run),
            None => {
                let given = as_given(run, true)
                    .map(|given| settings::of_experiment(&given))
                    .unwrap_or_default();
                groups.push(Alike {
                    method: [&run.algorithm, &run.variant],
                    settings,
                    given,
                    runs: vec![run],
                });
            }
        }
    }
    let mut told: BTreeMap<[&str; 2], BTreeSet<&String>> = BTreeMap::new();
    for (index, one) in groups.iter().enumerate() {
        for other in groups[..index].iter().filter(|other| other.method == one.method) {
            // Two tasks have values of their own, by which runs are of one method; any other value
            // is a method of its own.
            let are_own = |key: &str| {
                one.runs[0].task != other.runs[0].task && one.has_own(key) && other.has_own(key)
            };
            let apart = differences(&one.settings, &other.settings).filter(|key| !are_own(key));
            told.entry(one.method).or_default().extend(apart);
        }
    }
    let all = groups.iter().map(|Alike { method, settings: own, given, runs }| {
        let value = |key: &String| {
            own.get(key).map_or_else(|| format!("no {key}"), |value| format!("{key} = {value}"))
        };
        let changed =
            told.get(method).into_iter().flatten().filter(|key| given.get(**key) != own.get(**key));
        let called = std::iter::once(runs[0].label.clone());
        let name = Vec::from_iter(called.chain(changed.map(|key| value(key))));
        let is_beside =
            |other: &&Alike| other.runs[0].task == runs[0].task && other.method[0] == method[0];
        let beside =
            groups.iter().filter(is_beside).flat_map(|other| differences(own, &other.settings));
        let differs = BTreeSet::from_iter(beside).into_iter().map(value).collect();
        group(runs, name.join(", "), differs, select)
    });
    all.collect()
}

fn group(runs: &[&RunReport], method: String, differs: Vec<String>, select: Select) -> GroupReport {
    let mut counted: Vec<&RunReport> = Vec::new();
    let mut left_out = Vec::new();
    for run in runs {
        let dir = run.dir.display();
        if !run.evaluations.iter().any(|evaluation| evaluation.complete) {
            left_out.push(format!("{dir} has no complete evaluation"));
        } else if let Some(first) = counted.iter().find(|other| other.seed == run.seed) {
            left_out.push(format!(
                "{dir} has seed {} like {}, which is counted",
                run.seed,
                first.dir.display()
            ));
        } else {
            counted.push(run);
        }
    }
    let over = |value: fn(&RunReport) -> Option<f64>| {
        let values: Option<Vec<_>> = counted.iter().map(|run| value(run)).collect();
        Spread::of(&values?)
    };
    let score = |run: &&RunReport| match select {
        Select::Last => run.score(),
        Select::Best => run.best().map(|best| best.score.mean),
    };
    let scores: Option<Vec<f64>> = counted.iter().map(score).collect();
    let first = runs[0];
    let scored_in = joined(counted.iter().flat_map(|run| &run.precisions));
    let published = published::scores(&first.task);
    let environment = environment::find(&first.config.experiment.environment).ok();
    let has_one_goal =
        environment.is_some_and(|environment| environment.goal == Some(Goal::EachInstance));
    let unfinished = counted.iter().filter(|run| !run.is_complete());
    GroupReport {
        task: first.task.clone(),
        algorithm: first.algorithm.clone(),
        variant: first.variant.clone(),
        method,
        agent: first.agent.clone(),
        methods: published::methods(&first.algorithm, &first.variant),
        steps: first.steps,
        reached: first.reached(),
        device: first.config.run.device,
        normalized: first.normalized,
        seeds: counted.iter().map(|run| run.seed).collect(),
        scores: scores.filter(|_| first.is_complete()).unwrap_or_default(),
        goals: has_one_goal.then_some(counted.len()),
        mean_last_3: over(|run| run.mean_last_3),
        mean_last_5: over(|run| run.mean_last_5),
        mean_last_50000_steps: over(|run| run.mean_last_50000_steps),
        best: over(|run| run.best().map(|best| best.score.mean)).filter(|_| select == Select::Best),
        unfinished: unfinished
            .map(|run| format!("in {} {}", run.dir.display(), run.how_complete()))
            .collect(),
        left_out,
        differs,
        dirs: runs.iter().map(|run| run.dir.clone()).collect(),
        departures: if published.is_empty() {
            Vec::new()
        } else {
            departures(&counted, &scored_in, select)
        },
        runs: counted.into_iter().cloned().collect(),
        scored_in,
        published,
    }
}
