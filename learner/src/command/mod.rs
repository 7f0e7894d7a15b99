//! The learner's commands, from the parsed command line to the exit code. All of them run on the
//! main thread.

mod dataset_hints;
mod doctor;
mod dry_run;
mod export;
mod from;
mod make;
mod outside;
mod sweep;
mod train;

use std::fmt::Alignment::{Left, Right};
use std::io;
use std::path::Path;

use anyhow::anyhow;
use clap::CommandFactory;
use clap_complete::Shell;
use quad_algorithms::{ALGORITHMS, Definition, Values};
use quad_dataset::{DatasetError, OnlineEpisode, benchmarks, environment};
use quad_protocol::Episode;
use quad_run::config::{ConfigError, Preset, hyperparameters, tasks};
use quad_run::counted;
use quad_run::folder::verify::{self, Findings};
use quad_run::folder::{RunDir, RunDirError, verify_experience};
use quad_run::status::list;
use quad_run::table::{Style, Table};
use quad_runtime::{
    Health, Hint, LEAVE_WITHIN, ListenError, hinted, json, print, serve_metrics, shutdown_signal,
    stay_in_background, unfinished, unfinished_at_signal,
};
use serde::Serialize;
use tokio::runtime::{Builder, Runtime};
use tracing::{info, warn};

use crate::cli::{
    Cli, Command, DatasetsCommand, DoctorArgs, InspectArgs, JudgeArgs, ListArgs, PageArgs,
    PresetsArgs, ReportArgs, VerifyArgs,
};
use crate::data::{Source, cache_folder, cached, load, made_folder};
use crate::judge::judge;
use crate::page;
use crate::report::{Report, draw_all, write_html};

const DAMAGED: &str = "put a copy of the damaged file in its place; a line of scores.jsonl may also be taken out: its episode \
                       is scored again";

const NOTHING: &str = "nothing is checked: the run has no evaluations, and neither `learner judge` nor experience has \
                       kept the hash of a snapshot; --same-as OTHER compares it with another run";

pub fn run(cli: &Cli) -> anyhow::Result<()> {
    use DatasetsCommand::Make;
    if matches!(cli.command, Command::Train(_) | Command::Sweep(_) | Command::Datasets(Make(_))) {
        unfinished_at_signal();
    }
    let done = match &cli.command {
        Command::Train(args) => train::train(args),
        Command::Sweep(args) => sweep::sweep(args),
        Command::Presets(args) => list_presets(args),
        Command::Datasets(command) => datasets(command),
        Command::Report(args) => report(args),
        Command::Export(args) => export::export(args),
        Command::ExportData(args) => export::export_data(args),
        Command::Judge(args) => rank(args),
        Command::Verify(args) => check_runs(args),
        Command::List(args) => list_runs(args),
        Command::Page(args) => serve_page(args),
        Command::Doctor(args) => examine(args),
        Command::Completions { shell } => completions(*shell),
    };
    done.map_err(|error| {
        let Some(cause) = error.downcast_ref::<RunDirError>() else { return error };
        let hint = cause.hint();
        match cause {
            // The learner that is at work there may complete the run, or leave it to this command.
            RunDirError::InUse(_) => unfinished(error, hint),
            _ => hinted(error, hint),
        }
    })
}

/// A runtime for all that is neither training nor Zenoh, which have threads of their own.
fn runtime() -> io::Result<Runtime> {
    let mut runtime = Builder::new_multi_thread();
    runtime.worker_threads(2).enable_all();
    runtime.on_thread_start(stay_in_background).build()
}

fn show(
    as_json: bool,
    result: &impl Serialize,
    text: impl FnOnce() -> String,
) -> anyhow::Result<()> {
    print(&if as_json { json(result)? } else { text() })
}

fn list_presets(args: &PresetsArgs) -> anyhow::Result<()> {
    if let Some(preset) = &args.preset {
        let preset = Preset::read(preset).hint_of(ConfigError::hint)?;
        return print_preset(&preset, args.algorithm.as_deref());
    }
    if args.metrics {
        return print_metrics(args.algorithm.as_deref());
    }
    let mut tasks = table(["task", "environment", "dataset", "what it is"]);
    for task in tasks::list().iter().filter(|task| task.is_listed) {
        let [environment, dataset] =
            ["environment", "dataset"].map(|key| task.text(key).unwrap_or("-"));
        tasks.push([&*task.name, environment, dataset, &task.about].map(str::to_owned));
    }
    let header = ["algorithm", "what it is", "its authors give values for", "GFLOP a step"];
    let mut algorithms = table(header);
    for definition in ALGORITHMS {
        let (name, values) = (definition.name.to_owned(), Values::read(definition));
        let words = |(name, tasks): (_, &Vec<_>)| format!("{name}: {}", tasks.join(", "));
        let given = Vec::from_iter(values.given.iter().map(words)).join("; ");
        algorithms.push([name, values.about, given, values.gflop]);
    }
    let [tasks, algorithms] = [tasks, algorithms].map(|table| table.render(Style::Text));
    print(&format!("{tasks}\n{algorithms}"))
}

fn table<const N: usize>(header: [&str; N]) -> Table {
    Table::new(&header.map(|name| (name, Left)))
}

fn print_metrics(algorithm: Option<&str>) -> anyhow::Result<()> {
    let mut tables = Vec::new();
    for Definition { name, metrics, .. } in ALGORITHMS {
        if algorithm.is_some_and(|asked| asked != *name) {
            continue;
        }
        let mut table = table([*name, "held out", "what it is"]);
        for metric in *metrics {
            let held_out = if metric.held_out { "yes" } else { "" };
            table.push([metric.name, held_out, metric.help].map(str::to_owned));
        }
        tables.push(table.render(Style::Text));
    }
    print(&tables.join("\n"))
}

fn print_preset(preset: &Preset, algorithm: Option<&str>) -> anyhow::Result<()> {
    let changes = algorithm.map(|name| ("algorithm".to_owned(), name.into()));
    let experiment = preset.resolve(&changes.into_iter().collect()).hint_of(ConfigError::hint)?;
    let mut text = toml::to_string(&experiment)?;
    if let Some(task) = preset.task
        && let Some(warning) = hyperparameters::not_given(&experiment.definition()?, task)
    {
        text = format!("# {warning}\n\n{text}");
    }
    print(&text)
}

fn report(args: &ReportArgs) -> anyhow::Result<()> {
    let report = Report::read(&args.dirs, args.select)?;
    for error in &report.unreadable {
        warn!("not in this report: {error}");
    }
    if let Some(folder) = &args.figures {
        draw_all(folder, &report)?;
        info!("figures: {}", folder.display());
    }
    if let Some(path) = &args.html {
        write_html(path, &report)?;
        info!("report: {}", path.display());
    }
    let style = if args.latex { Style::Latex } else { Style::Text };
    show(args.json, &report, || report.render(style))?;
    all_readable(report.unreadable.len())
}

/// Fails, after all else was done, if folders could not be read.
fn all_readable(unreadable: usize) -> anyhow::Result<()> {
    if unreadable == 0 {
        return Ok(());
    }
    Err(anyhow!("{} cannot be read", counted(unreadable, "folder"))).hint(DAMAGED)
}

fn check_runs(args: &VerifyArgs) -> anyhow::Result<()> {
    let (mut all_held, mut unreadable) = (true, 0);
    for dir in &args.dirs {
        let about = match args.dirs.len() {
            1 => String::new(),
            _ => format!("{}: ", dir.display()),
        };
        match check_run(dir, &about, args.same_as.as_deref()) {
            Ok(held) => all_held &= held,
            Err(error) if args.dirs.len() > 1 => {
                warn!("{about}{error:#}");
                unreadable += 1;
            }
            Err(error) => return Err(error),
        }
    }
    anyhow::ensure!(all_held, "not everything held");
    all_readable(unreadable)
}

/// Prints what holds of a run. True if everything does.
fn check_run(dir: &Path, about: &str, same_as: Option<&Path>) -> anyhow::Result<bool> {
    let (mut all_held, mut checked) = (true, 0);
    let mut report = |about: &str, findings: Findings| {
        all_held &= findings.all_held();
        checked += findings.expected;
        print(&format!("{about}{findings}"))
    };
    report(about, verify::verify(dir)?)?;
    let config = RunDir::at(dir).read_config()?;
    // By the run's dataset, if that is still there: training leaves out what is far from its range.
    let data = config.experiment.online.as_ref().and_then(|_| {
        load(&config.dataset.paths(), &config.experiment, Some(&config.dataset.held_out)).ok()
    });
    let is_left_out = |episode: &Episode| {
        let Episode { observations, actions, rewards, terminated, .. } = episode;
        let rows = OnlineEpisode { observations, actions, rewards, terminated: *terminated };
        data.as_ref().is_some_and(|data| matches!(data.training.add_episode(rows), Ok(Some(_))))
    };
    if let Some((findings, promise)) = verify_experience(dir, is_left_out)? {
        report(about, findings)?;
        print(&format!("{about}{promise}"))?;
    }
    if let Some(other) = same_as {
        for findings in verify::compare(dir, other)? {
            report(&format!("{about}with {}: ", other.display()), findings)?;
        }
    }
    if checked == 0 {
        print(&format!("{about}{NOTHING}"))?;
    }
    Ok(all_held && checked > 0)
}

fn list_runs(args: &ListArgs) -> anyhow::Result<()> {
    let entries = list::list(&args.dirs);
    show(args.json, &entries, || list::table(&entries))?;
    let unreadable = Vec::from_iter(entries.iter().filter_map(list::Entry::unreadable));
    if unreadable.is_empty() {
        return Ok(());
    }
    let hint = match args.dirs.iter().all(|dir| dir.is_dir()) {
        true => DAMAGED,
        false => "`learner list DIR` lists the runs below another folder",
    };
    let text = unreadable.join("\n  ");
    Err(anyhow!("some runs cannot be read:\n  {text}")).hint(hint)
}

fn rank(args: &JudgeArgs) -> anyhow::Result<()> {
    let ranking = judge(&args.policies, &args.dataset, args.steps, args.seeds)?;
    let blocks = ranking.blocks().map(|block| block.render(Style::Text));
    show(args.json, &ranking, || blocks.join("\n"))
}

fn completions(shell: Shell) -> anyhow::Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut Cli::command(), "learner", &mut script);
    print(&String::from_utf8_lossy(&script))
}

fn examine(args: &DoctorArgs) -> anyhow::Result<()> {
    let findings = doctor::examine(args)?;
    show(args.json, &findings, || findings.to_string())?;
    Ok(findings.verdict()?)
}

fn datasets(command: &DatasetsCommand) -> anyhow::Result<()> {
    match command {
        DatasetsCommand::List => {
            let [size, cache] = [("size", Right), ("in the cache", Left)];
            let mut table = Table::new(&[("dataset", Left), ("environment", Left), size, cache]);
            for dataset in cached() {
                table.push(dataset?);
            }
            let mut folders = Vec::new();
            for benchmark in benchmarks::list() {
                let folder = cache_folder(benchmark)?;
                folders.push(format!("{} of {}", folder.display(), benchmark.name));
            }
            folders.push(format!("{} of `datasets make`", made_folder()?.display()));
            let (table, folders) = (table.render(Style::Text), folders.join(", "));
            print(&format!("{table}\ncache folders: {folders}"))
        }
        DatasetsCommand::Fetch { name } => {
            let dataset = Source::named(name)?.obtain()?;
            print(&dataset.path.display().to_string())
        }
        DatasetsCommand::Inspect(args) => inspect(args),
        DatasetsCommand::Make(args) => make::make(args),
    }
}

fn inspect(args: &InspectArgs) -> anyhow::Result<()> {
    let sources = Source::parse_all(&args.datasets)?;
    let named = || sources.iter().find_map(|source| Some(&*source.entry()?.environment));
    let environment = args.env.or_else(|| environment::find(named()?).ok());
    let mut paths = Vec::new();
    for source in &sources {
        let path = match source {
            Source::Path(path) => path.clone(),
            source => source.obtain()?.path,
        };
        if let Some(doubt) = environment.and_then(|spec| source.doubt(&path, &spec.name)) {
            warn!("{doubt}");
        }
        paths.push(path);
    }
    let mut inspection = quad_dataset::inspect(&paths, environment).hint_of(DatasetError::hint)?;
    for file in inspection.files.iter_mut().filter(|_| paths.len() > 1) {
        file.sha256 = Some(Source::Path(file.path.clone()).obtain()?.sha256);
    }
    show(args.json, &inspection, || inspection.to_string())?;
    let (problems, names) = (inspection.problems.len(), args.datasets.join(", "));
    anyhow::ensure!(problems == 0, "{} in {names}", counted(problems, "problem"));
    Ok(())
}

/// Serves the page of all runs until a signal.
fn serve_page(args: &PageArgs) -> anyhow::Result<()> {
    let folder = args.runs.display();
    if !args.runs.is_dir() {
        return Err(anyhow!("there is no folder {folder}")).hint("name one: learner page DIR");
    }
    let runtime = Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let page = page::routes(args.runs.clone(), None);
        let server =
            serve_metrics(args.http, &args.http_hosts, Default::default(), Health::default(), page);
        let server = server.await;
        let server = server.hint_of(ListenError::hint)?;
        info!("page: http://{}/ shows the runs in {folder}; Ctrl-C ends it", server.address);
        shutdown_signal(LEAVE_WITHIN).await;
        Ok(())
    })
}
