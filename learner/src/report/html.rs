//! The report as one HTML file that needs no other file: to send to a colleague, or to print.

use std::collections::BTreeSet;
use std::io::{self, ErrorKind};
use std::path::Path;

use anyhow::Context;
use base64::prelude::{BASE64_STANDARD, Engine};
use minijinja::Environment;
use minijinja::value::Serde;
use quad_run::files;
use quad_run::results::RunReport;
use serde_json::{Value, json};
use tracing::warn;

use super::figures;
use super::remake;
use super::seeds::GroupReport;
use super::summary::Report;

/// Pictures of an episode that a run's folder may hold, with their media types and what such a file
/// begins with: `evaluator film RUN --out RUN/film.gif`.
const FILMS: [(&str, &str, &[u8]); 2] =
    [("film.png", "image/png", b"\x89PNG\r\n\x1a\n"), ("film.gif", "image/gif", b"GIF8")];
/// Largest film, bytes: many times as large as any of ours.
const LARGEST: u64 = 1 << 25;

/// Writes the report.
///
/// # Errors
/// The file cannot be written.
pub fn write(path: &Path, report: &Report) -> anyhow::Result<()> {
    let mut templates = Environment::new();
    // By its name all that is filled in is escaped, and nothing of a run's name is taken for HTML.
    templates.add_template("report.html", include_str!("../../assets/report.html"))?;
    let page = templates.get_template("report.html")?.render(Serde(page(report)?))?;
    files::replace(path, page.as_bytes())
        .with_context(|| format!("cannot write {}", path.display()))
}

/// What the template is filled with.
fn page(report: &Report) -> anyhow::Result<Value> {
    let tasks: BTreeSet<&str> = report.runs.iter().map(|run| &*run.task).collect();
    let plural = if report.runs.len() == 1 { "" } else { "s" };
    let complete = report.runs.iter().filter(|run| run.is_complete()).count();
    let figures = figures::all(report).into_iter().map(|(_, picture)| {
        let svg = picture.svg()?;
        Ok(json!({ "title": picture.title, "svg": svg }))
    });
    let groups = report.groups.iter().map(|group| of_group(group, &report.runs));
    Ok(json!({
        "title": Vec::from_iter(tasks).join(", "),
        "subtitle": format!("{} run{plural}, {complete} complete", report.runs.len()),
        "version": env!("CARGO_PKG_VERSION"),
        "parts": report.summaries(true),
        "figures": figures.collect::<anyhow::Result<Value>>()?,
        "films": films(&report.runs),
        "groups": groups.collect::<anyhow::Result<Value>>()?,
        "commands": commands(&report.runs),
    }))
}

fn films(runs: &[RunReport]) -> Vec<Value> {
    let mut films = Vec::new();
    for run in runs {
        for (path, kind, begin) in
            FILMS.map(|(name, kind, begin)| (run.dir.join(name), kind, begin))
        {
            match film(&path, begin) {
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

/// Reads a film. The folder may be another user's, and the report is made to be sent: no other file
/// gets into it by a link or another name.
fn film(path: &Path, begin: &[u8]) -> io::Result<Vec<u8>> {
    let mut file = files::open(path)?;
    if file.metadata()?.len() > LARGEST {
        return Err(ErrorKind::FileTooLarge.into());
    }
    let bytes = files::rest(&mut file, 0)?;
    if bytes.starts_with(begin) {
        Ok(bytes)
    } else {
        Err(io::Error::other("it is no such picture"))
    }
}

/// Runs that differ in their seed alone: their settings are without it.
fn of_group(group: &GroupReport, runs: &[RunReport]) -> anyhow::Result<Value> {
    let runs: Vec<&RunReport> = runs.iter().filter(|run| group.dirs.contains(&run.dir)).collect();
    let once_each = |value: &dyn Fn(&RunReport) -> Option<String>| {
        let values: BTreeSet<String> = runs.iter().filter_map(|run| value(run)).collect();
        Vec::from_iter(values).join("\n")
    };
    let summary =
        |run: &RunReport| Some(format!("{}: {}", run.run, run.summary.as_ref()?.text.trim()));
    let title =
        runs.iter().find_map(|run| run.summary.as_ref()).map_or("", |summary| summary.title);
    let dataset = |run: &RunReport| {
        let data = &run.config.dataset;
        let name = run.config.experiment.dataset.as_deref().unwrap_or_default();
        let sha256 = data.sha256.as_deref().unwrap_or("unknown");
        let returns = format!("returns from {:.1} to {:.1}", data.min_return, data.max_return);
        Some(format!("{name}: {}, {returns}\nSHA-256 {sha256}", data.summary()))
    };
    let facts = [
        ("algorithm", group.agent.clone()),
        ("behind it", group.behind()),
        ("data", once_each(&dataset)),
        ("learner", once_each(&|run| Some(format!("version {}", run.config.run.version)))),
        ("trained on", once_each(&|run| run.config.run.machine.clone())),
        ("departures", group.departures.join("\n")),
        (title, once_each(&summary)),
    ];
    let facts = facts
        .into_iter()
        .filter(|(_, value)| !value.is_empty())
        .map(|(name, value)| json!({ "name": name, "value": value }));
    let mut settings =
        toml::Table::try_from(&runs.first().context("a group has runs")?.config.experiment)?;
    settings.remove("seed");
    Ok(json!({
        "title": format!("{}: {}", group.task, group.method),
        "facts": Value::from_iter(facts),
        "settings": toml::to_string(&settings)?,
    }))
}

fn commands(runs: &[RunReport]) -> String {
    let command = |run: &RunReport| {
        remake::command(run).unwrap_or_else(|| {
            // Quoted: a folder's name may have two lines.
            format!("# {:?}: save the settings below as FILE.toml, and learner train --preset FILE.toml", run.dir)
        })
    };
    let dirs: Vec<String> =
        runs.iter().map(|run| remake::quoted(&run.dir.to_string_lossy())).collect();
    let report = format!("learner report {} --html report.html", dirs.join(" "));
    runs.iter().map(command).chain([report]).collect::<Vec<_>>().join("\n")
}
