//! The learner's commands, from the command line to the exit. All of it runs on the main thread.

mod doctor;
mod train;

use std::fmt::Alignment::{Left, Right};

use quad_dataset::{DatasetError, environment};
use quad_service::{Hint, hinted};
use tracing::{info, warn};

use crate::cli::{Cli, Command, DatasetsCommand, DoctorArgs, InspectArgs, PresetsArgs, ReportArgs, VerifyArgs, print};
use crate::config::{self, presets};
use crate::data::{Source, cache};
use crate::report::{Report, Style, Table, learning_curves};
use crate::run::{RunDir, RunDirError, verify};

/// Does what the command line says.
///
/// # Errors
/// It cannot, or what it had to check is not as it must be.
pub fn run(cli: &Cli) -> anyhow::Result<()> {
    let done = match &cli.command {
        Command::Train(args) => train::train(args),
        Command::Presets(args) => list_presets(args),
        Command::Datasets(command) => datasets(command),
        Command::Report(args) => report(args),
        Command::Verify(args) => check_run(args),
        Command::Doctor(args) => examine(args),
    };
    done.map_err(|error| match error.downcast_ref().map(RunDirError::hint) {
        Some(hint) => hinted(error, hint),
        None => error,
    })
}

fn list_presets(args: &PresetsArgs) -> anyhow::Result<()> {
    if let Some(preset) = &args.preset {
        return print(&toml::to_string(&config::resolve(preset, &toml::Table::new())?)?);
    }
    let tasks = presets::tasks()?;
    let bases = presets::names().filter(|name| tasks.iter().all(|[task, ..]| task != name));
    let bases = Vec::from_iter(bases).join(", ");
    let mut table = Table::new(&["preset", "environment", "dataset", "what is special"].map(|name| (name, Left)));
    tasks.into_iter().for_each(|task| table.push(task));
    print(&format!("{}\nBases of these, which name no environment: {bases}", table.render(Style::Text)))
}

fn report(args: &ReportArgs) -> anyhow::Result<()> {
    // What else lies beside runs, where a user writes `runs/*`, does not keep them from being read.
    let (runs, others): (Vec<_>, Vec<_>) = args.dirs.iter().cloned().partition(|dir| RunDir::is_occupied(dir));
    let dirs = if runs.is_empty() { &args.dirs } else { &runs };
    let report = Report::read(dirs)?;
    for other in &others {
        warn!("there is no run in {}", other.display());
    }
    if let Some(path) = &args.plot {
        learning_curves(path, &report.runs)?;
        info!("learning curves: {}", path.display());
    }
    print(&match (args.json, args.markdown) {
        (true, _) => serde_json::to_string_pretty(&report)?,
        (_, true) => report.markdown(),
        _ => report.text(),
    })
}

fn check_run(args: &VerifyArgs) -> anyhow::Result<()> {
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
        DatasetsCommand::List => {
            let folder = cache::folder()?;
            let header = [("dataset", Left), ("environment", Left), ("size", Right), ("in the cache", Left)];
            let mut table = Table::new(&header);
            cache::list(&folder).for_each(|dataset| table.push(dataset));
            print(&format!("{}\ncache folder: {}", table.render(Style::Text), folder.display()))
        }
        DatasetsCommand::Fetch { name } => print(&Source::named(name)?.obtain()?.path.display().to_string()),
        DatasetsCommand::Inspect(args) => inspect(args),
    }
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
    print(&if args.json { serde_json::to_string_pretty(&inspection)? } else { inspection.to_string() })
}
