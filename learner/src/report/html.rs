//! The report as one self-contained HTML file, to share or to print.

use std::collections::BTreeSet;
use std::io::ErrorKind;
use std::path::Path;

use anyhow::Context;
use base64::prelude::{BASE64_STANDARD, Engine};
use minijinja::Environment;
use minijinja::value::Serde;
use quad_run::config::tasks;
use quad_run::folder::RunDir;
use quad_run::results::RunReport;
use quad_run::{counted, files};
use serde_json::{Value, json};
use tracing::warn;

use super::figures;
use super::groups::GroupReport;
use super::summary::Report;

/// Names, media types and first bytes of the films that a run's folder may have.
const FILMS: [(&str, &str, &[u8]); 2] =
    [("film.png", "image/png", b"\x89PNG\r\n\x1a\n"), ("film.gif", "image/gif", b"GIF8")];
/// Largest film, bytes.
const MAX_FILM: usize = 1 << 25;

pub fn write(path: &Path, report: &Report) -> anyhow::Result<()> {
    let mut templates = Environment::new();
    // A template of this name escapes what is filled in: a run's name is no HTML.
    templates.add_template("report.html", include_str!("../../assets/report.html"))?;
    let template = templates.get_template("report.html")?;
    let page = template.render(Serde(content(report)?))?;
    Ok(RunDir::write_named(path, page.as_bytes())?)
}

fn content(report: &Report) -> anyhow::Result<Value> {
    let tasks: BTreeSet<&str> = report.runs.iter().map(|run| &*run.task).collect();
    let complete = report.runs.iter().filter(|run| run.is_complete()).count();
    let mut plots = Vec::new();
    for (_, plot) in figures::figures(report) {
        plots.push(json!({ "title": plot.title, "svg": plot.svg()? }));
    }
    let groups = report.groups.iter().map(|runs| group(runs, &report.runs));
    Ok(json!({
        "title": Vec::from_iter(tasks).join(", "),
        "subtitle": format!("{}, {complete} complete", counted(report.runs.len(), "run")),
        "version": env!("CARGO_PKG_VERSION"),
        "blocks": report.summaries(true),
        "figures": plots,
        "films": films(&report.runs),
        "groups": groups.collect::<anyhow::Result<Vec<_>>>()?,
        "commands": commands(report),
    }))
}

fn films(runs: &[RunReport]) -> Vec<Value> {
    let mut films = Vec::new();
    for (run, (name, kind, magic)) in runs.iter().flat_map(|run| FILMS.map(|film| (run, film))) {
        let path = run.dir.join(name);
        match files::read(&path) {
            Ok(bytes) if bytes.starts_with(magic) && bytes.len() <= MAX_FILM => {
                let data = format!("data:{kind};base64,{}", BASE64_STANDARD.encode(bytes));
                films.push(json!({ "run": run.run, "data": data }));
            }
            // The folder may be another user's: no other file gets into the report by this name.
            Ok(_) => warn!("{} is not in the report: it is no such picture", path.display()),
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => warn!("{} is not in the report: {error}", path.display()),
        }
    }
    films
}

/// Facts and settings of a group of runs that differ in their seeds.
fn group(group: &GroupReport, runs: &[RunReport]) -> anyhow::Result<Value> {
    let runs = Vec::from_iter(runs.iter().filter(|run| group.dirs.contains(&run.dir)));
    let distinct = |value: &dyn Fn(&RunReport) -> Option<String>| {
        let values: BTreeSet<String> = runs.iter().filter_map(|run| value(run)).collect();
        Vec::from_iter(values).join("\n")
    };
    let dataset = |run: &RunReport| {
        let data = &run.config.dataset;
        if data.files.is_empty() {
            return Some(data.summary());
        }
        let name = run.config.experiment.dataset.join(", ");
        let (summary, least, most) = (data.summary(), data.min_return, data.max_return);
        let returns = format!("returns from {least:.1} to {most:.1}");
        let files = data.files.iter().map(|file| format!("\n{}: {file}", file.path.display()));
        Some(format!("{name}: {summary}, {returns}{}", files.collect::<String>()))
    };
    let summary =
        |run: &RunReport| Some(format!("{}: {}", run.run, run.summary.as_ref()?.text.trim()));
    let mut titles = runs.iter().filter_map(|run| Some(run.summary.as_ref()?.title));
    let mut facts = vec![
        ("algorithm", group.agent.clone()),
        ("runs", group.provenance()),
        ("data", distinct(&dataset)),
        ("learner", distinct(&|run| Some(format!("version {}", run.config.run.version)))),
        ("trained on", distinct(&|run| run.config.run.machine.clone())),
        ("departures", group.departures.join("\n")),
        (titles.next().unwrap_or_default(), distinct(&summary)),
    ];
    facts.retain(|(_, value)| !value.is_empty());
    let first = &runs.first().context("a group has runs")?.config;
    let mut settings = toml::Table::try_from(&first.experiment)?;
    settings.remove("seed");
    // A share of 0 is not among the settings, but the task may have another.
    settings.insert("hold_out".to_owned(), first.experiment.hold_out.into());
    if tasks::named(&first.run.task).is_ok() {
        settings.insert("task".to_owned(), first.run.task.clone().into());
    }
    Ok(json!({
        "title": format!("{}: {}", group.task, group.method),
        "facts": facts,
        "settings": toml::to_string(&settings)?,
    }))
}

/// The commands that make the runs again, with the settings of group N in a file `settings-N.toml`.
fn commands(report: &Report) -> String {
    let (mut commands, mut report_again) = (Vec::new(), "learner report".to_owned());
    for run in &report.runs {
        let (dir, seed) = (quoted(&run.dir.to_string_lossy()), run.seed);
        let group = report.groups.iter().position(|group| group.dirs.contains(&run.dir));
        let (number, device) = (group.map_or(0, |index| index + 1), run.config.run.device.name());
        commands.push(match &run.config.experiment.from {
            // Debug output: a folder's name may have two lines.
            Some(hash) => format!("# {:?} goes on from the run with the checkpoint {hash}: learner train --from RUN", run.dir),
            None => format!("learner train --preset settings-{number}.toml --seed {seed} --device {device} --run-dir {dir}"),
        });
        report_again += &format!(" {dir}");
    }
    commands.push(report_again + " --html report.html");
    commands.join("\n")
}

/// Quotes a word for a shell.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,+".contains(c);
    match !word.is_empty() && word.chars().all(is_plain) {
        true => word.to_owned(),
        false => format!("'{}'", word.replace('\'', r"'\''")),
    }
}
