//! `learner train`, from the parsed command line to the report.

use std::num::NonZero;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, anyhow};
use quad_dataset::{Split, Task, environment};
use quad_policy::Precision;
use quad_protocol::Name;
use quad_run::config::{
    ConfigError, DatasetInfo, Experiment, Preset, RunConfig, RunInfo, hyperparameters,
};
use quad_run::folder::{ExistingRun, Log, ResumePoint, RunDir};
use quad_run::results::RunReport;
use quad_runtime::{
    Health, Hint, ListenError, hinted, print, serve_metrics, stay_in_background, unfinished,
};
use tokio::sync::mpsc;
use tracing::{debug, info, warn};

use super::dry_run;
use super::outside::{Outside, training_threads};
use crate::cli::TrainArgs;
use crate::data::{LocalDataset, Source, load};
use crate::live::{Display, Ending, Incarnation, Live, MainLoop, Metrics, Run, STUCK, Threads};
use crate::page;
use crate::report::learning_curve;
use crate::train::{HeldOut, begin, device};

/// How long a run that is not complete may take to write its report.
const REPORT_PATIENCE: Duration = Duration::from_secs(5);

/// Trains; a run that does not complete is an error.
pub fn train(args: &TrainArgs) -> anyhow::Result<()> {
    let preset = Preset::read(args.preset()).hint_of(ConfigError::hint)?;
    let experiment = preset.resolve(&args.changes()).hint_of(ConfigError::hint)?;
    let named = experiment
        .dataset
        .clone()
        .ok_or_else(|| anyhow!("preset {} names no dataset", preset.label));
    let benchmark = preset.task.and_then(|task| task.benchmark);
    let missing = match benchmark
        .and_then(|benchmark| Some((benchmark, benchmark.converter.as_ref()?)))
    {
        Some((benchmark, converter)) => format!(
            "its rewards come from {}'s simulator: with quad_rl and {converter} installed, `quad-convert {converter}:{} --out \
             FILE` makes a file for --dataset FILE",
            benchmark.name,
            preset.task_name()
        ),
        None => record_hint(&experiment),
    };
    let source = Source::parse(&named.hint(missing)?)?;
    source.check_environment(&experiment.environment)?;
    let path = match &args.run_dir {
        Some(path) => path.clone(),
        None => default_run_dir(&preset.label, &experiment)?,
    };
    let name = run_name(&path)?;
    let begun = ExistingRun::open(&path, args.fresh)?;
    let outside = Outside::new(args, &experiment)?;

    device::check(args.device, experiment.precision)?;
    let dataset = source.obtain().hint(record_hint(&experiment))?;

    start_pool(args.threads)?;
    let data = load(&dataset.path, &experiment)?;
    let config = run_config(args, &name, preset.task_name(), experiment, dataset, &data)?;
    if let Some(begun) = &begun {
        begun.check_same_config(&config)?;
    }
    info!("{}", config.dataset.summary());
    info!("{}", config.experiment.summary()?);
    if let Some(task) = preset.task
        && let Some(warning) = hyperparameters::not_given(&config.experiment.definition()?, task)
    {
        warn!("{warning}");
    }
    let Experiment { environment: acts_in, eval_interval, .. } = &config.experiment;
    if *eval_interval > 0 && environment::find(acts_in).is_err() {
        info!(
            "scores come from evaluators that have the environment {acts_in}, which only Python's can (docs/python.md)"
        );
    }
    if !config.experiment.precision.is_available() {
        warn!("{}", Precision::UNAVAILABLE);
    }
    debug!("{config:?}");
    if args.dry_run {
        return dry_run::estimate(&path, &config, data.training);
    }

    // Zenoh and training have threads of their own; this runtime serves the metrics and the main
    // loop.
    let mut runtime = tokio::runtime::Builder::new_multi_thread();
    let runtime =
        runtime.worker_threads(2).on_thread_start(stay_in_background).enable_all().build()?;
    let ended = runtime.block_on(run_to_end(args, outside, &path, begun, name, &config, data));
    let concluded = ended.and_then(|(run_dir, ending)| conclude(&run_dir, &config, ending));
    // Does not wait for a thread that a broken disk blocks.
    runtime.shutdown_background();
    concluded
}

/// Starts rayon's threads for training.
fn start_pool(asked: Option<NonZero<usize>>) -> anyhow::Result<()> {
    let threads = training_threads(asked);
    let pool = rayon::ThreadPoolBuilder::new().thread_name(|_| "training".to_owned());
    pool.num_threads(threads)
        .build_global()
        .with_context(|| format!("cannot start {threads} threads for training"))
        .hint("choose fewer by --threads or RAYON_NUM_THREADS")
}

/// A hint for a run without a dataset.
fn record_hint(Experiment { environment: name, .. }: &Experiment) -> String {
    let is_recorded = environment::find(name).is_ok_and(|spec| spec.maze.is_none());
    let other = match is_recorded {
        true => format!("`evaluator collect --env {name} --out FILE` records one"),
        false => "docs/data.md says what it may be".to_owned(),
    };
    format!("name a file as `dataset`, on the command line by --dataset FILE; {other}")
}

async fn run_to_end(
    args: &TrainArgs,
    mut outside: Outside,
    path: &Path,
    begun: Option<ExistingRun>,
    name: Name,
    config: &RunConfig,
    data: Split,
) -> anyhow::Result<(RunDir, Ending)> {
    let steps = config.experiment.steps;
    let (metrics, registry) = Metrics::new(&name, steps, config.experiment.definition()?.metrics)?;
    let health = Health::default();
    let live = Live::new(name.clone(), steps, metrics.clone(), health.clone());
    let telling = live.clone();
    let page = page::routes(path.to_owned(), Some(Arc::new(move || telling.tell())))?;
    let server = serve_metrics(args.http, registry, health.clone(), page)
        .await
        .hint_of(ListenError::hint)?;
    info!("page: http://{}/", server.address);
    let Experiment { environment, .. } = &config.experiment;
    let Split { training, held_out, .. } = data;
    let task = Task::new(environment, training.observation_dim(), training.action_dim());
    let mut agent = begin(&config.experiment, config.run.device, training)?;
    let held_out = held_out.and_then(|held_out| {
        HeldOut::new(&config.experiment, config.run.device, held_out, &mut agent)
    });
    let opening = outside.open().await?;
    // All checks are done, so a start that is refused leaves no folder behind.
    let (run_dir, scores, past) = open_or_create(path, begun, args.fresh, config)?;
    let (tx, events) = mpsc::unbounded_channel();
    // A later start has a larger number; the low bits distinguish two that start in the same
    // millisecond.
    let incarnation =
        Incarnation { run: name, number: now()? << 16 | u64::from(rand::random::<u16>()) };
    let checkpoint_every = Duration::from_secs(args.checkpoint_seconds);
    let run = Run {
        incarnation: incarnation.clone(),
        config,
        dir: &run_dir,
        scores,
        past,
        checkpoint_every,
    };
    let threads = Threads::start(run, task, (agent, held_out), &metrics, &health, &tx)?;
    threads.show_on(&live);
    let main_loop = MainLoop {
        incarnation,
        run_dir: run_dir.clone(),
        display: Display::start(metrics.clone(), steps),
        metrics,
        metrics_address: server.address.to_string(),
        endpoints: outside.endpoints,
        events,
        threads,
        beat: health.register("main", STUCK),
        health,
        evaluators: outside.evaluators,
    };
    Ok((run_dir, main_loop.run(opening).await))
}

/// Opens or makes the run's folder, and reads what it contains.
fn open_or_create(
    path: &Path,
    begun: Option<ExistingRun>,
    fresh: bool,
    config: &RunConfig,
) -> anyhow::Result<(RunDir, Log, ResumePoint)> {
    match begun {
        Some(begun) if !fresh => return Ok(begun.resume(&config.experiment)?),
        Some(begun) => begun.set_aside()?,
        None => {}
    }
    let (run_dir, scores) = RunDir::create(path, config)?;
    Ok((run_dir, scores, ResumePoint::default()))
}

/// Milliseconds since 1970.
fn now() -> anyhow::Result<u64> {
    Ok(SystemTime::now().duration_since(UNIX_EPOCH)?.as_millis() as u64)
}

/// Writes the report after any ending; a run that did not complete is an error.
fn conclude(run_dir: &RunDir, config: &RunConfig, ending: Ending) -> anyhow::Result<()> {
    let folder = run_dir.path().display();
    let reported = match &ending {
        Ending::Complete => summarize(run_dir),
        // The run may have failed because its disk hangs, and one that was told to stop has little
        // time.
        _ => {
            let run_dir = run_dir.clone();
            within(REPORT_PATIENCE, move || summarize(&run_dir))
        }
    };
    let kept = format!(
        "everything up to the newest checkpoint is kept in {folder}; the same command continues from there"
    );
    let error = match ending {
        Ending::Complete => return all_scored(reported?),
        Ending::Failed(error) => hinted(error, kept),
        Ending::Interrupted => {
            let steps = config.experiment.steps;
            unfinished(
                anyhow!("interrupted before the end of {steps} steps and their evaluations"),
                kept,
            )
        }
        Ending::Unscored => unfinished(
            anyhow!(
                "training is complete, but no evaluator came that has the environment {}",
                config.experiment.environment
            ),
            "start one and give the same command again, which waits for the scores; or let the learner start some, by \
             --evaluators N",
        ),
    };
    if let Err(error) = reported {
        warn!("the run has no report: {error:#}");
    }
    Err(error)
}

/// Checks that no episode was given up.
fn all_scored(report: RunReport) -> anyhow::Result<()> {
    let missing = report.episodes_missing;
    if missing == 0 {
        return Ok(());
    }
    let hint = "the log says why; fix it, and the same command hands them out again";
    Err(anyhow!("training is complete, but {missing} episodes have no score")).hint(hint)
}

/// Runs `work` on another thread, and stops waiting for it after a limit.
fn within<T: Send + 'static>(
    patience: Duration,
    work: impl FnOnce() -> anyhow::Result<T> + Send + 'static,
) -> anyhow::Result<T> {
    let (tx, rx) = std::sync::mpsc::channel();
    std::thread::spawn(move || tx.send(work()));
    rx.recv_timeout(patience).unwrap_or_else(|_| Err(anyhow!("it took longer than {patience:?}")))
}

fn summarize(run_dir: &RunDir) -> anyhow::Result<RunReport> {
    let report = RunReport::read(run_dir.path())?;
    let mut text = String::new();
    if !report.evaluations.is_empty() {
        run_dir.write_json("report.json", &report)?;
        let picture = run_dir.path().join("learning_curve.svg");
        learning_curve(&report).write_svg(&picture)?;
        text = format!("\n{}\nlearning curve: {}\n", report.text(), picture.display());
    }
    print(&format!("{text}run folder: {}", run_dir.path().display()))?;
    Ok(report)
}

fn default_run_dir(label: &str, experiment: &Experiment) -> anyhow::Result<PathBuf> {
    let variant = experiment.variant()?;
    Ok(Path::new("runs").join(format!("{label}-{variant}-seed{}", experiment.seed)))
}

/// The run's name: the folder's name, which is also part of its Zenoh keys.
fn run_name(path: &Path) -> anyhow::Result<Name> {
    let folder = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    Name::new(folder)
        .with_context(|| format!("the run folder {} gives no name for the run", path.display()))
        .hint("its last part must be 1 to 64 letters, digits, dots, dashes or underscores")
}

/// Names the CPU and the instructions that training uses.
fn machine(precision: Precision) -> String {
    let cpu = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = cpu.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    let name = name.map_or(std::env::consts::ARCH, |(_, name)| name.trim());
    format!("{name}, {} threads, {}", rayon::current_num_threads(), precision.arithmetic())
}

fn run_config(
    args: &TrainArgs,
    name: &Name,
    task: &str,
    experiment: Experiment,
    dataset: LocalDataset,
    data: &Split,
) -> anyhow::Result<RunConfig> {
    let statistics = data.training.statistics();
    Ok(RunConfig {
        run: RunInfo {
            name: name.clone(),
            started: now()?,
            task: task.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            machine: Some(machine(experiment.precision)),
            device: args.device,
        },
        dataset: DatasetInfo {
            path: dataset.path,
            sha256: Some(dataset.sha256),
            transitions: statistics.transitions as u64,
            episodes: statistics.episodes as u64,
            held_out: data.episodes.clone(),
            min_return: statistics.return_min,
            mean_return: statistics.return_mean,
            max_return: statistics.return_max,
            mean_score: statistics.score_mean,
        },
        experiment,
    })
}
