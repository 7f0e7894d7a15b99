//! The learner's commands, from the parsed command line to the exit code. All of them run on the
//! main thread.

mod doctor;
mod dry_run;
mod export;
mod judge;
mod outside;
mod page;
mod sweep;
mod train;

use std::fmt::Alignment::{Left, Right};

use anyhow::anyhow;
use clap::CommandFactory;
use clap_complete::Shell;
use quad_algorithms::{ALGORITHMS, Definition, Metric, Values};
use quad_dataset::{DatasetError, benchmarks, environment};
use quad_run::config::{ConfigError, Preset, hyperparameters, tasks};
use quad_run::folder::{RunDirError, verify};
use quad_run::status::list;
use quad_run::table::{Style, Table};
use quad_runtime::{Hint, hinted, json, print, unfinished};
use tracing::{info, warn};

use crate::cli::{
    Cli, Command, DatasetsCommand, DoctorArgs, InspectArgs, ListArgs, PresetsArgs, ReportArgs,
    VerifyArgs,
};
use crate::data::{Source, cache};
use crate::report::{Report, draw_all, write_html};

/// Runs the command.
///
/// # Errors
/// The command failed, or a check failed.
pub fn run(cli: &Cli) -> anyhow::Result<()> {
    let done = match &cli.command {
        Command::Train(args) => train::train(args),
        Command::Sweep(args) => sweep::sweep(args),
        Command::Presets(args) => list_presets(args),
        Command::Datasets(command) => datasets(command),
        Command::Report(args) => report(args),
        Command::Export(args) => export::export(args),
        Command::Judge(args) => judge::run(args),
        Command::Verify(args) => check_runs(args),
        Command::List(args) => list_runs(args),
        Command::Page(args) => page::show(args),
        Command::Doctor(args) => examine(args),
        Command::Completions { shell } => completions(*shell),
    };
    done.map_err(|error| match error.downcast_ref() {
        // The learner that is at work there may complete the run, or leave it to this command.
        Some(in_use @ RunDirError::InUse(_)) => {
            let hint = in_use.hint();
            unfinished(error, hint)
        }
        Some(other) => {
            let hint = other.hint();
            hinted(error, hint)
        }
        None => error,
    })
}

fn list_presets(args: &PresetsArgs) -> anyhow::Result<()> {
    if let Some(preset) = &args.preset {
        return print_preset(
            &Preset::read(preset).hint_of(ConfigError::hint)?,
            args.algorithm.as_deref(),
        );
    }
    if args.metrics {
        return print_metrics(args.algorithm.as_deref());
    }
    let header = ["task", "environment", "dataset", "what it is"];
    let mut of_tasks = Table::new(&header.map(|name| (name, Left)));
    for task in tasks::all().iter().filter(|task| task.is_listed) {
        let word = |key| task.text(key).unwrap_or("-");
        of_tasks.push(
            [&*task.name, word("environment"), word("dataset"), &task.about].map(str::to_owned),
        );
    }
    let header = ["algorithm", "what it is", "its authors give values for", "GFLOP a step"];
    let mut of_algorithms = Table::new(&header.map(|name| (name, Left)));
    for definition in ALGORITHMS {
        let values = Values::of(definition);
        let given = values.given.iter();
        let given = given.map(|(benchmark, tasks)| format!("{benchmark}: {}", tasks.join(", ")));
        of_algorithms.push([
            definition.name.to_owned(),
            values.about,
            given.collect::<Vec<_>>().join("; "),
            values.gflop,
        ]);
    }
    print(&format!("{}\n{}", of_tasks.render(Style::Text), of_algorithms.render(Style::Text)))
}

/// What algorithms measure, or the one of that name.
fn print_metrics(algorithm: Option<&str>) -> anyhow::Result<()> {
    let asked = |known: &&Definition| algorithm.is_none_or(|name| known.name == name);
    let tables = ALGORITHMS.iter().filter(asked).map(|Definition { name, metrics, .. }| {
        let mut table = Table::new(&[*name, "held out", "what it is"].map(|title| (title, Left)));
        let held_out = |metric: &Metric| if metric.held_out { "yes" } else { "" };
        metrics
            .iter()
            .for_each(|it| table.push([it.name, held_out(it), it.help].map(str::to_owned)));
        table.render(Style::Text)
    });
    print(&Vec::from_iter(tables).join("\n"))
}

fn print_preset(preset: &Preset, algorithm: Option<&str>) -> anyhow::Result<()> {
    let changes = algorithm.map(|name| ("algorithm".to_owned(), name.into()));
    let experiment = preset.resolve(&changes.into_iter().collect()).hint_of(ConfigError::hint)?;
    let definition = experiment.definition()?;
    let not_given = preset.task.and_then(|task| hyperparameters::not_given(&definition, task));
    let comment = not_given.map(|sentence| format!("# {sentence}\n\n")).unwrap_or_default();
    print(&(comment + &toml::to_string(&experiment)?))
}

fn report(args: &ReportArgs) -> anyhow::Result<()> {
    let report = Report::read(&args.dirs, args.select)?;
    report.unreadable.iter().for_each(|error| warn!("not in this report: {error}"));
    if let Some(folder) = &args.figures {
        draw_all(folder, &report)?;
        info!("figures: {}", folder.display());
    }
    if let Some(path) = &args.html {
        write_html(path, &report)?;
        info!("report: {}", path.display());
    }
    let style = match (args.markdown, args.latex) {
        (true, _) => Style::Markdown,
        (_, true) => Style::Latex,
        _ => Style::Text,
    };
    print(&if args.json { json(&report)? } else { report.render(style) })?;
    all_readable(report.unreadable.len())
}

/// An error if that many folders could not be read, after all else was done.
fn all_readable(unreadable: usize) -> anyhow::Result<()> {
    let hint = "put a copy of the damaged file in its place; a line of scores.jsonl may also be taken out: its episode is \
                scored again";
    if unreadable == 0 {
        Ok(())
    } else {
        Err(anyhow!("{unreadable} folders cannot be read")).hint(hint)
    }
}

fn check_runs(args: &VerifyArgs) -> anyhow::Result<()> {
    let mut all_held = true;
    for dir in &args.dirs {
        let about =
            if args.dirs.len() > 1 { format!("{}: ", dir.display()) } else { String::new() };
        let mut findings = vec![(about, verify::verify(dir)?)];
        if let Some(other) = &args.same_as {
            findings.extend(
                verify::compare(dir, other)?
                    .map(|found| (format!("with {}: ", other.display()), found)),
            );
        }
        for (about, found) in &findings {
            print(&format!("{about}{found}"))?;
            all_held &= found.all_held();
        }
    }
    anyhow::ensure!(all_held, "not everything held");
    Ok(())
}

fn list_runs(args: &ListArgs) -> anyhow::Result<()> {
    let entries = list::list(&args.dirs);
    print(&if args.json { json(&entries)? } else { list::table(&entries) })?;
    let unreadable: Vec<_> = entries.iter().filter_map(list::Entry::unreadable).collect();
    anyhow::ensure!(
        unreadable.is_empty(),
        "some runs cannot be read:\n  {}",
        unreadable.join("\n  ")
    );
    Ok(())
}

fn completions(shell: Shell) -> anyhow::Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut Cli::command(), "learner", &mut script);
    print(&String::from_utf8_lossy(&script))
}

fn examine(args: &DoctorArgs) -> anyhow::Result<()> {
    let findings = doctor::examine(args)?;
    print(&if args.json { json(&findings)? } else { findings.to_string() })?;
    Ok(findings.verdict()?)
}

fn datasets(command: &DatasetsCommand) -> anyhow::Result<()> {
    match command {
        DatasetsCommand::List => {
            let header =
                [("dataset", Left), ("environment", Left), ("size", Right), ("in the cache", Left)];
            let mut table = Table::new(&header);
            for dataset in cache::list() {
                table.push(dataset?);
            }
            let mut folders = Vec::new();
            for benchmark in benchmarks::all() {
                folders.push(format!(
                    "{} of {}",
                    cache::folder(benchmark)?.display(),
                    benchmark.name
                ));
            }
            print(&format!("{}\ncache folders: {}", table.render(Style::Text), folders.join(", ")))
        }
        DatasetsCommand::Fetch { name } => {
            print(&Source::named(name)?.obtain()?.path.display().to_string())
        }
        DatasetsCommand::Inspect(args) => inspect(args),
    }
}

/// Prints what a dataset contains; one with problems is an error.
fn inspect(args: &InspectArgs) -> anyhow::Result<()> {
    let source = Source::parse(&args.dataset)?;
    let environment = args.env.or_else(|| environment::find(&source.entry()?.environment).ok());
    let path = match source {
        Source::Path(path) => path,
        source => source.obtain()?.path,
    };
    let inspection = quad_dataset::inspect(&path, environment).hint_of(DatasetError::hint)?;
    print(&if args.json { json(&inspection)? } else { inspection.to_string() })?;
    let problems = inspection.problems.len();
    anyhow::ensure!(problems == 0, "{problems} problems in {}", inspection.path.display());
    Ok(())
}
