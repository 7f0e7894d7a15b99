//! The pictures of runs: learning curves, performance profiles, scores over a hyper-parameter.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::Context;
use quad_algorithms::{ALGORITHMS, Axis, Definition};
use quad_run::config::settings::{self, Settings};
use quad_run::results::RunReport;
use quad_run::results::statistics::{self, Estimate, Runs};
use quad_runtime::Hint;

use super::plot::{Line, Picture};
use super::seeds::GroupReport;
use super::study::MethodReport;
use super::summary::Report;

const FOLDER: &str = "--figures names a folder that you may write in";
const BAND: &str = "mean over seeds, with its 95 % interval";

/// Draws all pictures of a report into a folder, each as SVG and as PNG. The folder is made if it
/// is not there.
pub fn draw_all(folder: &Path, report: &Report) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder)
        .with_context(|| format!("cannot make {}", folder.display()))
        .hint(FOLDER)?;
    for (name, picture) in all(report) {
        picture.write_svg(&folder.join(format!("{name}.svg")))?;
        picture.write_png(&folder.join(format!("{name}.png")))?;
    }
    Ok(())
}

/// A picture's name for its file. What a task is called may come from another user's run, so it
/// names no other folder.
fn of_task(kind: &str, task: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "-_.".contains(c);
    format!("{kind}-{}", task.replace(|c: char| !is_plain(c), "-"))
}

/// All pictures of a report, each with a name for its file: the learning curves of each task; the
/// scores over the hyper-parameter that an algorithm names, such as τ, where runs differ in it, all
/// tasks in one picture; the performance profiles of all tasks.
pub fn all(report: &Report) -> Vec<(String, Picture)> {
    if let [run] = &report.runs[..] {
        return vec![(of_task("curve", &run.task), of_run(run))];
    }
    let mut by_task: BTreeMap<&str, Vec<&GroupReport>> = BTreeMap::new();
    for group in report.groups.iter().filter(|group| !group.runs.is_empty()) {
        by_task.entry(&group.task).or_default().push(group);
    }
    let mut pictures = vec![("profile".to_owned(), profiles(report))];
    for (task, groups) in &by_task {
        pictures.push((of_task("curve", task), curves(task, groups)));
    }
    for Definition { name, report, .. } in ALGORITHMS {
        pictures.extend(
            report.axis.map(|axis| (axis.key.to_owned(), over_of_tasks(axis, name, &by_task))),
        );
    }
    pictures.retain(|(_, picture)| !picture.is_empty());
    pictures
}

/// The learning curve of one run: the mean over an evaluation's episodes ± one standard deviation,
/// and the dataset's mean.
pub fn of_run(run: &RunReport) -> Picture {
    let point = |step: u64, mean: f64, std: Option<f64>| {
        (
            step as f64,
            Estimate {
                value: mean,
                low: std.map(|std| mean - std),
                high: std.map(|std| mean + std),
            },
        )
    };
    let points = run.evaluations.iter().map(|e| point(e.step, e.score.mean, e.score.std)).collect();
    let episodes = run.evaluations.iter().map(|e| e.episodes).max().unwrap_or(0);
    let measure = run.measure_with_unit();
    Picture {
        title: format!("{}: {measure} over {episodes} episodes", run.run),
        x: "gradient steps",
        y: measure.to_owned(),
        references: vec![dataset_mean(run)],
        lines: vec![Line { label: format!("{} ({})", run.run, run.variant), points }],
        ..Picture::default()
    }
}

fn dataset_mean(run: &RunReport) -> (String, f64) {
    (format!("dataset mean {:.1}", run.dataset_score), run.dataset_score)
}

fn curves(task: &str, groups: &[&GroupReport]) -> Picture {
    let mut references = Vec::from_iter(groups.iter().map(|group| dataset_mean(&group.runs[0])));
    references.sort_by(|(_, one), (_, other)| one.total_cmp(other));
    references.dedup();
    Picture {
        title: format!("{task}: {BAND}"),
        x: "gradient steps",
        y: groups[0].measure().to_owned(),
        references,
        lines: groups.iter().map(|group| curve(group)).collect(),
        ..Picture::default()
    }
}

/// The mean over a group's seeds at each step that all have evaluated.
fn curve(group: &GroupReport) -> Line {
    let by_step = |run: &RunReport| -> BTreeMap<u64, f64> {
        run.evaluations.iter().filter(|e| e.complete).map(|e| (e.step, e.score.mean)).collect()
    };
    let all: Vec<BTreeMap<u64, f64>> = group.runs.iter().map(by_step).collect();
    let steps: Vec<u64> = all[0]
        .keys()
        .copied()
        .filter(|step| all.iter().all(|run| run.contains_key(step)))
        .collect();
    let scores: Vec<Vec<f64>> =
        all.iter().map(|run| steps.iter().map(|step| run[step]).collect()).collect();
    let seeds: Runs<&[f64]> = vec![scores.iter().map(Vec::as_slice).collect()];
    let means = |drawn: &[Runs<&[f64]>]| {
        let seeds = &drawn[0][0];
        (0..steps.len())
            .map(|at| seeds.iter().map(|scores| scores[at]).sum::<f64>() / seeds.len() as f64)
            .collect()
    };
    let points = steps
        .iter()
        .map(|step| *step as f64)
        .zip(statistics::estimates(&[&seeds], means))
        .collect();
    let plural = if group.runs.len() == 1 { "" } else { "s" };
    let part = if group.reached.is_some() { ", not complete" } else { "" };
    Line { label: format!("{} ({} seed{plural}{part})", group.method, group.runs.len()), points }
}

fn profiles(report: &Report) -> Picture {
    let with_profile = report.study.iter().filter(|method| !method.profile.is_empty());
    let line = |method: &MethodReport| Line {
        label: method.method.clone(),
        points: method.profile.iter().map(|point| (point.threshold, point.share)).collect(),
    };
    Picture {
        title: "Performance profile, with its 95 % interval".to_owned(),
        x: "D4RL-normalized score",
        y: "share of runs that score more".to_owned(),
        is_falling: true,
        lines: with_profile.map(line).collect(),
        ..Picture::default()
    }
}

/// Scores over a hyper-parameter of an algorithm, a panel for each task whose runs differ in it.
/// Over τ it is what Figures 3 and 4 of the paper show.
fn over_of_tasks(
    axis: Axis,
    algorithm: &str,
    by_task: &BTreeMap<&str, Vec<&GroupReport>>,
) -> Picture {
    let of_task = |(task, groups): (&&str, &Vec<&GroupReport>)| {
        let groups =
            Vec::from_iter(groups.iter().copied().filter(|group| group.algorithm == algorithm));
        over(axis, task, &groups)
    };
    let mut panels = Vec::from_iter(by_task.iter().map(of_task).filter(|panel| !panel.is_empty()));
    match panels.len() {
        1 => panels.remove(0),
        _ => Picture {
            title: format!("Scores over {}: {BAND}", axis.symbol),
            panels,
            ..Picture::default()
        },
    }
}

/// Scores of complete runs over a hyper-parameter, a line for each set of other settings that has
/// several values of it.
fn over(axis: Axis, task: &str, groups: &[&GroupReport]) -> Picture {
    let key = format!("agent.{}", axis.key);
    let mut lines: BTreeMap<Settings, Vec<(f64, &GroupReport)>> = BTreeMap::new();
    for group in groups.iter().filter(|group| !group.scores.is_empty()) {
        let mut others = settings::of_run(&group.runs[0].config);
        others.remove("seed");
        if let Some(value) = others.remove(&key).and_then(|value| value.parse().ok()) {
            lines.entry(others).or_default().push((value, group));
        }
    }
    let line = |mut points: Vec<(f64, &GroupReport)>| {
        points.sort_by(|(one, _), (other, _)| one.total_cmp(other));
        let mean = |drawn: &[Runs]| vec![statistics::mean_of_means(&drawn[0])];
        let score =
            |group: &GroupReport| statistics::estimates(&[&vec![group.scores.clone()]], mean)[0];
        let name = points[0].1.method.split(", ").filter(|part| !part.starts_with(&key));
        Line {
            label: Vec::from_iter(name).join(", "),
            points: points.iter().map(|(value, group)| (value.log10(), score(group))).collect(),
        }
    };
    Picture {
        title: format!("{task} over {}", axis.symbol),
        x: axis.symbol,
        is_power: true,
        y: groups.first().map_or("", |group| group.measure()).to_owned(),
        lines: lines.into_values().filter(|points| points.len() > 1).map(line).collect(),
        ..Picture::default()
    }
}
