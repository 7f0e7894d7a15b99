//! The figures of a report: learning curves, performance profiles, scores over a hyper-parameter.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use anyhow::Context;
use quad_algorithms::{ALGORITHMS, Axis, Definition};
use quad_run::config::settings::Settings;
use quad_run::results::RunReport;
use quad_run::results::statistics::{self, Estimate, Runs};
use quad_run::{counted, files};
use quad_runtime::Hint;

use super::groups::{GroupReport, seedless};
use super::methods::MethodReport;
use super::plot::{Line, Plot};
use super::summary::Report;

const BAND: &str = "mean over seeds, with its 95 % interval";

/// Writes all figures into a folder, each as SVG and as PNG.
pub fn draw_all(folder: &Path, report: &Report) -> anyhow::Result<()> {
    fs::create_dir_all(folder)
        .with_context(|| format!("cannot make {}", folder.display()))
        .hint("--figures names a folder that you may write in")?;
    for (name, plot) in figures(report) {
        for (ending, file) in [("svg", plot.svg()?.into_bytes()), ("png", plot.png()?)] {
            let path = folder.join(format!("{name}.{ending}"));
            files::replace(&path, &file)
                .with_context(|| format!("cannot write {}", path.display()))?;
        }
    }
    Ok(())
}

/// The file name of a task's figure. Another user may have named the task, so it is no path.
fn file_name(figure: &str, task: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "-_.".contains(c);
    format!("{figure}-{}", task.replace(|c: char| !is_plain(c), "-"))
}

/// All figures with their file names: performance profiles; and of each task the learning curves,
/// and for each algorithm scores over the hyper-parameter that it names, such as τ.
pub fn figures(report: &Report) -> Vec<(String, Plot)> {
    if let [run] = &report.runs[..] {
        return vec![(file_name("curve", &run.task), learning_curve(run))];
    }
    let mut by_task: BTreeMap<&str, Vec<&GroupReport>> = BTreeMap::new();
    for group in report.groups.iter().filter(|group| !group.runs.is_empty()) {
        by_task.entry(&group.task).or_default().push(group);
    }
    let mut plots = vec![("profile".to_owned(), profiles(report))];
    let mut push = |figure, task, plot| {
        let mut name = file_name(figure, task);
        while plots.iter().any(|(taken, _)| *taken == name) {
            name.push('-');
        }
        plots.push((name, plot));
    };
    for (task, groups) in &by_task {
        push("curve", task, curves(task, groups));
        for Definition { name, axis, .. } in ALGORITHMS {
            if let Some(axis) = *axis {
                push(axis.key, task, scores_over(axis, name, task, groups));
            }
        }
    }
    plots.retain(|(_, plot)| !plot.is_empty());
    plots
}

/// The learning curve of one run: mean over an evaluation's episodes ± one standard deviation.
pub fn learning_curve(run: &RunReport) -> Plot {
    let mut line = Line { label: format!("{} ({})", run.run, run.variant), points: Vec::new() };
    let mut episodes = 0;
    for evaluation in &run.evaluations {
        let (value, std) = (evaluation.score.mean, evaluation.score.std);
        let (low, high) = (std.map(|std| value - std), std.map(|std| value + std));
        line.points.push((evaluation.step as f64, Estimate { value, low, high }));
        episodes = episodes.max(evaluation.episodes);
    }
    let measure = run.measure_with_unit();
    Plot {
        title: format!("{}: {measure} over {episodes} episodes", run.run),
        x: "gradient steps",
        y: measure,
        references: dataset_mean(run).into_iter().collect(),
        begins: begins([run]),
        lines: vec![line],
        ..Plot::default()
    }
}

fn dataset_mean(run: &RunReport) -> Option<(String, f64)> {
    run.dataset_measure().map(|mean| (format!("dataset mean {mean:.1}"), mean))
}

/// Gradient steps after which online learning begins.
fn begins<'a>(runs: impl IntoIterator<Item = &'a RunReport>) -> BTreeSet<u64> {
    runs.into_iter().filter_map(|run| run.config.experiment.online_begins()).collect()
}

fn curves(task: &str, groups: &[&GroupReport]) -> Plot {
    let references = groups.iter().filter_map(|group| dataset_mean(&group.runs[0]));
    let mut references = Vec::from_iter(references);
    references.sort_by(|(_, one), (_, other)| one.total_cmp(other));
    references.dedup();
    Plot {
        title: format!("{task}: {BAND}"),
        x: "gradient steps",
        y: groups[0].measure(),
        references,
        begins: begins(groups.iter().map(|group| &group.runs[0])),
        lines: groups.iter().map(|group| curve(group)).collect(),
        ..Plot::default()
    }
}

/// The mean over a group's seeds at each step that all have evaluated.
fn curve(group: &GroupReport) -> Line {
    let mut runs: Vec<BTreeMap<u64, f64>> = Vec::new();
    for run in &group.runs {
        let complete = run.evaluations.iter().filter(|evaluation| evaluation.complete);
        runs.push(complete.map(|evaluation| (evaluation.step, evaluation.score.mean)).collect());
    }
    let mut steps = Vec::from_iter(runs[0].keys());
    steps.retain(|step| runs.iter().all(|run| run.contains_key(step)));
    let seeds: Runs<&BTreeMap<u64, f64>> = vec![runs.iter().collect()];
    let means = statistics::estimates(&[&seeds], |drawn: &[Runs<&BTreeMap<u64, f64>>]| {
        let runs = &drawn[0][0];
        let mean = |step| runs.iter().map(|run| run[step]).sum::<f64>() / runs.len() as f64;
        steps.iter().copied().map(mean).collect()
    });
    let part = group.reached.map_or("", |_| ", not complete");
    let label = format!("{} ({}{part})", group.method, counted(group.runs.len(), "seed"));
    let points = steps.iter().map(|step| **step as f64).zip(means).collect();
    Line { label, points }
}

fn profiles(report: &Report) -> Plot {
    let mut lines = Vec::new();
    for MethodReport { method, profile, .. } in &report.study {
        let label = method.clone();
        let points = profile.iter().map(|point| (point.threshold, point.share)).collect();
        lines.push(Line { label, points });
    }
    lines.retain(|line| !line.points.is_empty());
    Plot {
        title: "Performance profile, with its 95 % interval".to_owned(),
        x: "D4RL-normalized score",
        y: "share of runs that score more",
        lines,
        ..Plot::default()
    }
}

/// Scores of a task over a hyper-parameter of an algorithm: over τ, Figures 3 and 4 of the paper. A
/// line for each set of other settings with several values of the hyper-parameter.
fn scores_over(axis: Axis, algorithm: &str, task: &str, groups: &[&GroupReport]) -> Plot {
    let key = format!("agent.{}", axis.key);
    let mut by_settings: BTreeMap<Settings, Vec<(f64, &GroupReport)>> = BTreeMap::new();
    for group in groups.iter().filter(|group| group.algorithm == algorithm) {
        let mut settings = seedless(&group.runs[0].config);
        let value = settings.remove(&key).and_then(|value| value.parse().ok());
        if let Some(value) = value.filter(|_| !group.scores.is_empty()) {
            by_settings.entry(settings).or_default().push((value, group));
        }
    }
    let mean = |drawn: &[Runs]| vec![statistics::mean_of_means(&drawn[0])];
    let mut lines = Vec::new();
    for mut groups in by_settings.into_values().filter(|groups| groups.len() > 1) {
        groups.sort_by(|(one, _), (other, _)| one.total_cmp(other));
        let (mut names, mut points) = (Vec::from_iter(groups[0].1.method.split(", ")), Vec::new());
        names.retain(|name| !name.starts_with(&key));
        for (value, group) in groups {
            let score = statistics::estimates(&[&vec![group.scores.clone()]], mean)[0];
            points.push((value.log10(), score));
        }
        lines.push(Line { label: names.join(", "), points });
    }
    Plot {
        title: format!("{task} over {}: {BAND}", axis.symbol),
        x: axis.symbol,
        is_log: true,
        y: groups.first().map_or("", |group| group.measure()),
        lines,
        ..Plot::default()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use quad_run::folder::RunDir;
    use quad_run::results::Select;

    use super::*;
    use crate::fixtures::{config, line};

    #[test]
    fn curves_are_means_over_runs_of_means_over_episodes() {
        let folder = tempfile::tempdir().unwrap();
        for (seed, scores) in [(0, [[1.0, 3.0], [10.0, 20.0]]), (1, [[5.0, 7.0], [1.0, 2.0]])] {
            let run = folder.path().join(seed.to_string());
            let (_, mut log) = RunDir::create(&run, &config("r", seed)).unwrap();
            for (step, scores) in [2000, 4000].into_iter().zip(scores) {
                let lines =
                    scores.into_iter().zip(1..).map(|(score, seed)| line(step, seed, score));
                log.append(&Vec::from_iter(lines)).unwrap();
            }
        }
        let read = |path: &str| {
            let report = Report::read(&[folder.path().join(path)], Select::Last).unwrap();
            let (_, plot) = figures(&report).remove(0);
            let points = plot.lines[0].points.iter();
            let points = points.map(|(x, y)| (*x, y.value, y.high.unwrap() - y.value));
            (plot.references, Vec::from_iter(points))
        };
        let mean = vec![("dataset mean 10.7".to_owned(), 10.7)];
        // Of two runs, an interval is from one to the other.
        assert_eq!(read(""), (mean.clone(), vec![(2000.0, 4.0, 2.0), (4000.0, 8.25, 6.75)]));
        let deviations = [2.0, 50.0].map(f64::sqrt);
        let alone = vec![(2000.0, 2.0, deviations[0]), (4000.0, 15.0, deviations[1])];
        let (references, points) = read("0");
        assert_eq!(references, mean);
        for (point, expected) in points.iter().zip(&alone) {
            assert_eq!((point.0, point.1), (expected.0, expected.1));
            assert!((point.2 - expected.2).abs() < 1e-9, "{points:?}");
        }
    }
}
