//! The learner's commands, from the command line to the exit.

mod doctor;
mod train;

use std::io::{ErrorKind, Write};

use quad_dataset::{DatasetError, environment};
use quad_service::{Hint, hinted};
use toml::Table;
use tracing::{info, warn};

use crate::cli::{Cli, Command, DatasetsCommand, DoctorArgs, InspectArgs, PresetsArgs, ReportArgs, VerifyArgs};
use crate::config::{self, Experiment};
use crate::datasets::{self, Source};
use crate::plot;
use crate::presets;
use crate::report::Report;
use crate::run::{RunDir, RunDirError};
use crate::verify;

/// Does what the command line says.
pub fn run(cli: &Cli) -> anyhow::Result<()> {
    carry_out(&cli.command).map_err(|error| match error.downcast_ref().map(RunDirError::hint) {
        Some(hint) => hinted(error, hint),
        None => error,
    })
}

fn carry_out(command: &Command) -> anyhow::Result<()> {
    match command {
        Command::Train(args) => train::train(args),
        Command::Presets(args) => list_presets(args),
        Command::Datasets(command) => datasets(command),
        Command::Report(args) => report(args),
        Command::Verify(args) => verify(args),
        Command::Doctor(args) => examine(args),
    }
}

fn list_presets(args: &PresetsArgs) -> anyhow::Result<()> {
    let text = match &args.preset {
        Some(preset) => toml::to_string(&resolve(preset, &Table::new())?)?,
        None => presets::list()?,
    };
    Ok(print(text.trim_end())?)
}

fn resolve(preset: &str, changes: &Table) -> anyhow::Result<Experiment> {
    config::resolve(preset, changes).or_else(|error| match error.hint() {
        Some(hint) => Err(error).hint(hint),
        None => Err(error.into()),
    })
}

fn report(args: &ReportArgs) -> anyhow::Result<()> {
    // What else lies beside runs, where somebody writes `runs/*`, does not keep them from being read.
    let (runs, others): (Vec<_>, Vec<_>) = args.dirs.iter().cloned().partition(|dir| RunDir::is_occupied(dir));
    let dirs = if runs.is_empty() { &args.dirs } else { &runs };
    let report = Report::read(dirs)?;
    for other in &others {
        warn!("there is no run in {}", other.display());
    }
    if let Some(path) = &args.plot {
        plot::learning_curves(path, &report.runs)?;
        info!("learning curves: {}", path.display());
    }
    let text = match (args.json, args.markdown) {
        (true, _) => serde_json::to_string_pretty(&report)?,
        (_, true) => report.markdown(),
        _ => report.text(),
    };
    print(text.trim_end())?;
    Ok(())
}

fn verify(args: &VerifyArgs) -> anyhow::Result<()> {
    let mut findings = vec![(String::new(), verify::verify(&args.dir)?)];
    if let Some(other) = &args.same_as {
        findings.push((format!("with {}: ", other.display()), verify::compare(&args.dir, other)?));
    }
    for (about, found) in &findings {
        print(&format!("{about}{found}"))?;
    }
    anyhow::ensure!(findings.iter().all(|(_, found)| found.all_held()), "not everything held");
    Ok(())
}

fn examine(args: &DoctorArgs) -> anyhow::Result<()> {
    let findings = doctor::examine(args)?;
    print(&if args.json { findings.json()? } else { findings.to_string() })?;
    findings.verdict()
}

fn datasets(command: &DatasetsCommand) -> anyhow::Result<()> {
    match command {
        DatasetsCommand::List => print(&datasets::cache::table(&datasets::cache::folder()?))?,
        DatasetsCommand::Fetch { name } => {
            let dataset = Source::Named(datasets::source::named(name)?).obtain()?;
            print(&dataset.path.display().to_string())?;
        }
        DatasetsCommand::Inspect(args) => inspect(args)?,
    }
    Ok(())
}

/// Problems are part of the result: only what cannot be read at all is an error.
fn inspect(args: &InspectArgs) -> anyhow::Result<()> {
    let source = Source::parse(&args.dataset)?;
    let environment = args.env.or_else(|| environment::find(&source.entry()?.environment).ok());
    let path = match source {
        Source::Path(path) => path,
        source => source.obtain()?.path,
    };
    let inspection = quad_dataset::inspect(&path, environment).hint_of(DatasetError::hint)?;
    match args.json {
        true => print(&serde_json::to_string_pretty(&inspection)?)?,
        false => print(&inspection.to_string())?,
    }
    Ok(())
}

/// Results go to stdout, logs do not. Whoever reads may stop at any time, like `head` does.
fn print(text: &str) -> std::io::Result<()> {
    match writeln!(std::io::stdout(), "{text}") {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        result => result,
    }
}
