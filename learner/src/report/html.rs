//! The report as one self-contained HTML file, to share or to print.

use std::collections::BTreeSet;
use std::io::{Error, ErrorKind, Result};
use std::path::Path;

use anyhow::Context;
use base64::prelude::{BASE64_STANDARD, Engine};
use minijinja::Environment;
use minijinja::value::Serde;
use quad_run::results::RunReport;
use quad_run::{counted, files};
use quad_runtime::Hint;
use serde_json::{Value, json};
use tracing::warn;

use super::figures;
use super::groups::GroupReport;
use super::reproduce;
use super::summary::Report;

/// Names, media types and first bytes of the films that a run's folder may have.
const FILMS: [(&str, &str, &[u8]); 2] =
    [("film.png", "image/png", b"\x89PNG\r\n\x1a\n"), ("film.gif", "image/gif", b"GIF8")];
/// Largest film, bytes.
const MAX_FILM: u64 = 1 << 25;

pub fn write(path: &Path, report: &Report) -> anyhow::Result<()> {
    let mut templates = Environment::new();
    // A template of this name escapes what is filled in: a run's name is no HTML.
    templates.add_template("report.html", include_str!("../../assets/report.html"))?;
    let template = templates.get_template("report.html")?;
    let page = template.render(Serde(content(report)?))?;
    files::replace(path, page.as_bytes())
        .with_context(|| format!("cannot write {}", path.display()))
        .hint("--html names a file in a folder that is there and that you may write in")
}

fn content(report: &Report) -> anyhow::Result<Value> {
    let tasks: BTreeSet<&str> = report.runs.iter().map(|run| &*run.task).collect();
    let complete = report.runs.iter().filter(|run| run.is_complete()).count();
    let mut plots = Vec::new();
    for (_, plot) in figures::all(report) {
        plots.push(json!({ "title": plot.title, "svg": plot.svg()? }));
    }
    let mut groups = Vec::new();
    for group in &report.groups {
        groups.push(of_group(group, &report.runs)?);
    }
    Ok(json!({
        "title": Vec::from_iter(tasks).join(", "),
        "subtitle": format!("{}, {complete} complete", counted(report.runs.len(), "run")),
        "version": env!("CARGO_PKG_VERSION"),
        "blocks": report.summaries(true),
        "figures": plots,
        "films": films(&report.runs),
        "groups": groups,
        "commands": commands(&report.runs),
    }))
}

fn films(runs: &[RunReport]) -> Vec<Value> {
    let mut films = Vec::new();
    for run in runs {
        for (name, kind, magic) in FILMS {
            let path = run.dir.join(name);
            match film(&path, magic) {
                Ok(bytes) => {
                    let data = format!("data:{kind};base64,{}", BASE64_STANDARD.encode(bytes));
                    films.push(json!({ "run": run.run, "data": data }));
                }
                Err(error) if error.kind() == ErrorKind::NotFound => {}
                Err(error) => warn!("{} is not in the report: {error}", path.display()),
            }
        }
    }
    films
}

/// Reads a film. The folder may be another user's: no other file gets into the report by a link or
/// another name.
fn film(path: &Path, magic: &[u8]) -> Result<Vec<u8>> {
    let mut file = files::open(path)?;
    if file.metadata()?.len() > MAX_FILM {
        return Err(ErrorKind::FileTooLarge.into());
    }
    let bytes = files::rest(&mut file, 0)?;
    let is_film = bytes.starts_with(magic);
    is_film.then_some(bytes).ok_or_else(|| Error::other("it is no such picture"))
}

fn of_group(group: &GroupReport, runs: &[RunReport]) -> anyhow::Result<Value> {
    let runs = Vec::from_iter(runs.iter().filter(|run| group.dirs.contains(&run.dir)));
    let distinct = |value: &dyn Fn(&RunReport) -> Option<String>| {
        let values: BTreeSet<String> = runs.iter().filter_map(|run| value(run)).collect();
        Vec::from_iter(values).join("\n")
    };
    let dataset = |run: &RunReport| {
        let data = &run.config.dataset;
        let name = run.config.experiment.dataset.as_deref().unwrap_or_default();
        let sha256 = data.sha256.as_deref().unwrap_or("unknown");
        let (summary, least, most) = (data.summary(), data.min_return, data.max_return);
        let returns = format!("returns from {least:.1} to {most:.1}");
        Some(format!("{name}: {summary}, {returns}\nSHA-256 {sha256}"))
    };
    let version = |run: &RunReport| Some(format!("version {}", run.config.run.version));
    let machine = |run: &RunReport| run.config.run.machine.clone();
    let summary = |run: &RunReport| {
        let text = run.summary.as_ref()?.text.trim();
        Some(format!("{}: {text}", run.run))
    };
    let mut titles = runs.iter().filter_map(|run| Some(run.summary.as_ref()?.title));
    let mut facts = vec![
        ("algorithm", group.agent.clone()),
        ("runs", group.provenance()),
        ("data", distinct(&dataset)),
        ("learner", distinct(&version)),
        ("trained on", distinct(&machine)),
        ("departures", group.departures.join("\n")),
        (titles.next().unwrap_or_default(), distinct(&summary)),
    ];
    facts.retain(|(_, value)| !value.is_empty());
    let first = &runs.first().context("a group has runs")?.config;
    let mut settings = toml::Table::try_from(&first.experiment)?;
    settings.remove("seed");
    Ok(json!({
        "title": format!("{}: {}", group.task, group.method),
        "facts": facts,
        "settings": toml::to_string(&settings)?,
    }))
}

fn commands(runs: &[RunReport]) -> String {
    let (mut commands, mut report) = (Vec::new(), "learner report".to_owned());
    for run in runs {
        // Debug output: a folder's name may have two lines.
        commands.push(reproduce::command(run).unwrap_or_else(|| {
            format!("# {:?}: save the settings below as FILE.toml, and learner train --preset FILE.toml", run.dir)
        }));
        report += &format!(" {}", reproduce::quoted(&run.dir.to_string_lossy()));
    }
    commands.push(report + " --html report.html");
    commands.join("\n")
}
