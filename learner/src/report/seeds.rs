//! Groups runs that differ only in their seed.

use std::collections::BTreeSet;
use std::path::PathBuf;

use quad_dataset::{Goal, environment};
use quad_run::config::Device;
use quad_run::config::settings::{self, Settings, differences};
use quad_run::results::departures::{as_given, departures};
use quad_run::results::published::{self, Published};
use quad_run::results::run::{RunReport, joined};
use quad_run::results::{Select, Spread};
use serde::Serialize;

/// Runs that differ in their seed alone: in task, data, device and every hyper-parameter they agree, and in how far they have
/// come. The precision in which evaluators scored them may differ; it is named.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GroupReport {
    /// What they learn.
    pub task: String,
    /// Their algorithm.
    pub algorithm: String,
    /// The variant of the algorithm: the kind of guidance for QUAD, such as `quad`, `dac` and `none`, or another algorithm's name.
    pub variant: String,
    /// What tables and figures call these runs: the variant and, of the settings in which other runs of it on the task differ, those
    /// that are not the task's own.
    pub method: String,
    /// The hyper-parameters that matter most.
    pub agent: String,
    /// What the paper calls this variant of the algorithm, if it has a row of it.
    pub methods: Vec<&'static str>,
    /// Gradient steps that were asked for.
    pub steps: u64,
    /// Where runs that are not complete have come to: the step of their last complete evaluation.
    pub reached: Option<u64>,
    /// Where they trained.
    pub device: Device,
    /// Whether scores are D4RL-normalised; without reference returns they are returns.
    pub normalised: bool,
    /// Precision that the policies were scored in; several, if evaluators differed.
    pub scored_in: String,
    /// The seeds, one for each run that is counted.
    pub seeds: Vec<u64>,
    /// The score of each of these; empty if they are not complete, or have too few evaluations for one.
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
    /// How these runs depart from the paper's protocol; empty where the task is none of the paper's.
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
        let (steps, device, scored_in) = (self.steps_in_words(), self.device.name(), &self.scored_in);
        format!("{seeds} seed{plural}{goals}, {steps} on {device}, scored in {scored_in}")
    }

    /// What its numbers are.
    pub fn measure(&self) -> &'static str {
        if self.normalised { "D4RL-normalised score" } else { self.runs.first().map_or("return", RunReport::measure) }
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

/// Sorts runs into groups, in the order in which they are given.
pub fn groups(runs: &[RunReport], select: Select) -> Vec<GroupReport> {
    let mut groups: Vec<(Settings, Vec<&RunReport>)> = Vec::new();
    for run in runs {
        let mut settings = settings::of_run(&run.config);
        settings.remove("seed");
        let is_alike = |(known, members): &&mut (Settings, Vec<&RunReport>)| {
            let has_come_as_far = members[0].reached() == run.reached() || run.reached() == Some(0);
            members[0].task == run.task && *known == settings && has_come_as_far
        };
        match groups.iter_mut().find(is_alike) {
            Some((_, members)) => members.push(run),
            None => groups.push((settings, vec![run])),
        }
    }
    // The keys in which a group differs from others of its task.
    let differs = |index: usize, is_other: &dyn Fn(&RunReport) -> bool| {
        let (own, members) = &groups[index];
        let others = groups.iter().filter(|(_, others)| others[0].task == members[0].task && is_other(others[0]));
        others.flat_map(|(other, _)| differences(own, other)).collect::<BTreeSet<&String>>()
    };
    let all = groups.iter().enumerate().map(|(index, (own, runs))| {
        let value = |key: &String| own.get(key).map_or_else(|| format!("no {key}"), |value| format!("{key} = {value}"));
        let RunReport { algorithm, variant, called, .. } = runs[0];
        let of_variant = differs(index, &|other| (&other.algorithm, &other.variant) == (algorithm, variant));
        // Values that the task prescribes are not part of the name.
        let given = as_given(runs[0], true).map(|given| settings::of_experiment(&given)).unwrap_or_default();
        let changed = of_variant.into_iter().filter(|key| given.get(*key) != own.get(*key)).map(value);
        let method = Vec::from_iter(std::iter::once(called.clone()).chain(changed)).join(", ");
        let differs = differs(index, &|other| other.algorithm == *algorithm).into_iter().map(value).collect();
        group(runs, method, differs, select)
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
            left_out.push(format!("{dir} has seed {} like {}, which is counted", run.seed, first.dir.display()));
        } else {
            counted.push(run);
        }
    }
    let over = |value: fn(&RunReport) -> Option<f64>| {
        let values: Option<Vec<_>> = counted.iter().map(|run| value(run)).collect();
        Spread::of(&values?)
    };
    let score = |run: &&RunReport| match select {
        Select::Last => run.mean_last_5,
        Select::Best => run.best().map(|best| best.score.mean),
    };
    let scores: Option<Vec<f64>> = counted.iter().map(score).collect();
    let first = runs[0];
    let scored_in = joined(counted.iter().flat_map(|run| &run.precisions));
    let published = published::scores(&first.task);
    let environment = environment::find(&first.config.experiment.environment).ok();
    let has_one_goal = environment.is_some_and(|environment| environment.goal == Some(Goal::EachInstance));
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
        normalised: first.normalised,
        seeds: counted.iter().map(|run| run.seed).collect(),
        scores: scores.filter(|_| first.is_complete()).unwrap_or_default(),
        goals: has_one_goal.then_some(counted.len()),
        mean_last_3: over(|run| run.mean_last_3),
        mean_last_5: over(|run| run.mean_last_5),
        mean_last_50000_steps: over(|run| run.mean_last_50000_steps),
        best: over(|run| run.best().map(|best| best.score.mean)).filter(|_| select == Select::Best),
        unfinished: unfinished.map(|run| format!("in {} {}", run.dir.display(), run.how_complete())).collect(),
        left_out,
        differs,
        dirs: runs.iter().map(|run| run.dir.clone()).collect(),
        departures: if published.is_empty() { Vec::new() } else { departures(&counted, &scored_in, select) },
        runs: counted.into_iter().cloned().collect(),
        scored_in,
        published,
    }
}
