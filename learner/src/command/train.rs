//! `learner train`, from the parsed command line to the report.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, anyhow};
use quad_algorithms::{Agent, Examples};
use quad_dataset::{Split, Task, environment};
use quad_policy::Precision;
use quad_protocol::Name;
use quad_run::config::{ConfigError, DatasetInfo, Experiment, Preset, RunConfig, RunInfo};
use quad_run::folder::{Checkpoint, ExistingRun, Log, ResumePoint, RunDir};
use quad_run::results::RunReport;
use quad_run::{counted, files};
use quad_runtime::{Health, Hint, ListenError, hinted, print, serve_metrics, unfinished};
use rayon::ThreadPoolBuilder;
use tokio::runtime::Runtime;
use tokio::sync::mpsc;
use tokio::time::timeout;
use toml::Table;
use tracing::{debug, info, warn};

use super::dataset_hints::{convert_hint, record_hint};
use super::dry_run;
use super::from;
use super::outside::{Outside, training_threads};
use crate::cli::TrainArgs;
use crate::data::{Source, load, obtain};
use crate::live::{
    Display, Ending, Events, Incarnation, MainLoop, Metrics, PageState, Run, STUCK, Threads,
};
use crate::page;
use crate::report::learning_curve;
use crate::train::{HeldOut, begin, check_device};

/// Time limit for the report of a run that is not complete.
const REPORT_PATIENCE: Duration = Duration::from_secs(5);

pub fn train(args: &TrainArgs) -> anyhow::Result<()> {
    let named = args.run_dir.clone().or_else(|| args.from.as_deref().map(from::usual_folder));
    let (from, preset) = match (&args.from, &named) {
        (Some(source), Some(path)) => from::read(source, path, args.fresh)?,
        _ => (None, args.preset().hint_of(ConfigError::hint)?),
    };
    let changes = args.changes();
    let experiment = preset.resolve(&changes).hint_of(ConfigError::hint)?;
    if experiment.from.is_some() && (args.from.is_none() || changes.contains_key("from")) {
        return Err(anyhow!("the key `from` names a checkpoint, which is not there"))
            .hint("leave it out: --from RUN sets it, and begins with the run's last checkpoint");
    }
    let label = &preset.label;
    if experiment.dataset.is_empty() && experiment.definition()?.needs_data {
        return Err(anyhow!("{label} has no dataset of its own"))
            .hint(convert_hint(&preset).unwrap_or_else(|| record_hint(&experiment)));
    }
    let sources = Source::parse_all(&experiment.dataset)?;
    for source in &sources {
        source.check_environment(&experiment.environment)?;
    }
    let (variant, seed) = (experiment.variant()?, experiment.seed);
    // With and without online steps these are two runs.
    let online = experiment.online_begins().map_or("", |_| "-online");
    let usual = || Path::new("runs").join(format!("{label}-{variant}{online}-seed{seed}"));
    let path = named.unwrap_or_else(usual);
    let name = run_name(&path)?;
    let begun = ExistingRun::open(&path, args.fresh)?;
    let outside = Outside::new(args, &experiment)?;

    check_device(args.device, experiment.precision)?;
    let (paths, hashes) = obtain(&sources).hint(record_hint(&experiment))?;
    from.as_ref().map_or(Ok(()), |from| from.check(&experiment, &hashes.join(", ")))?;

    let threads = training_threads();
    let pool = ThreadPoolBuilder::new().thread_name(|_| "training".to_owned());
    pool.num_threads(threads)
        .build_global()
        .with_context(|| format!("cannot start {threads} threads for training"))
        .hint("choose fewer by RAYON_NUM_THREADS")?;
    let held_out = begun.as_ref().and_then(ExistingRun::held_out);
    let held_out = held_out.or(from.as_ref().map(|from| &*from.held_out));
    let data = load(&paths, &experiment, held_out)?;
    for warning in data.training.warnings() {
        warn!("{warning}");
    }
    let config = run_config(args, &name, preset.task_name(), experiment, hashes, &data)?;
    if let Some(begun) = &begun {
        begun.check_same_config(&config)?;
    }
    announce(&config, &preset, &changes, &sources)?;
    debug!("{config:?}");
    if args.dry_run {
        return dry_run::estimate(&path, &config, data);
    }

    let runtime = super::runtime()?;
    let first = from.map(|from| from.checkpoint);
    let run = run_to_end(args, outside, &path, (begun, first), &config, data);
    let ended = runtime.block_on(run);
    let concluded =
        ended.and_then(|(run_dir, ending)| conclude(&runtime, &run_dir, &config, ending));
    // Does not wait for a thread that a broken disk blocks.
    runtime.shutdown_background();
    concluded
}

/// Logs the data and the settings of the run, and warnings about them.
fn announce(
    config: &RunConfig,
    preset: &Preset,
    changes: &Table,
    sources: &[Source],
) -> anyhow::Result<()> {
    info!("{}", config.dataset.summary());
    for file in config.dataset.files.iter().filter(|_| sources.len() > 1) {
        info!("{}: {file}", file.path.display());
    }
    let experiment = &config.experiment;
    info!("{}", experiment.summary()?);
    for doubt in preset.doubts(experiment, changes)? {
        warn!("{doubt}");
    }
    if experiment.needs_evaluators() && environment::find(&experiment.environment).is_err() {
        info!(
            "no `evaluator serve` simulates {0}: quad_rl.evaluate(\"{0}\", …) in Python gives the scores (docs/python.md)",
            experiment.environment
        );
    }
    for (source, file) in sources.iter().zip(&config.dataset.files) {
        if let Some(doubt) = source.doubt(&file.path, &experiment.environment) {
            warn!("{doubt}");
        }
    }
    if !experiment.precision.is_available() {
        warn!("{}", Precision::UNAVAILABLE);
    }
    Ok(())
}

async fn run_to_end(
    args: &TrainArgs,
    mut outside: Outside,
    path: &Path,
    (begun, first): (Option<ExistingRun>, Option<Checkpoint>),
    config: &RunConfig,
    data: Split,
) -> anyhow::Result<(RunDir, Ending)> {
    let (run, experiment) = (&config.run.name, &config.experiment);
    let (metrics, registry) =
        Metrics::new(run, experiment.total_steps(), experiment.definition()?.metrics)?;
    let health = Health::default();
    let page_state = PageState {
        run: run.clone(),
        steps: experiment.total_steps(),
        metrics: metrics.clone(),
        health: health.clone(),
        carrier: Arc::default(),
    };
    let carrier = page_state.carrier.clone();
    let live = Arc::new(move || page_state.to_json());
    let page = page::routes(path.to_owned(), Some(live));
    let server = serve_metrics(args.http, &args.http_hosts, registry, health.clone(), page).await;
    let server = server.hint_of(ListenError::hint)?;
    info!("page: http://{}/", server.address);
    let (o, a) = (data.training.observation_dim(), data.training.action_dim());
    let task = Task::new(&experiment.environment, o, a);
    let (agent, examples, held_out) = begin_agent(config, data, first.as_ref())?;
    let opening = outside.open().await?;
    // All checks are done, so a start that is refused leaves no folder behind.
    let (dir, scores, past) = open_or_create(path, (begun, first), args.fresh, config)?;
    // A later start has a larger number; the low bits distinguish two that start in the same
    // millisecond.
    let number = now()? << 16 | u64::from(rand::random::<u16>());
    let incarnation = Incarnation { run: run.clone(), number };
    let checkpoint_every = Duration::from_secs(args.checkpoint_seconds);
    let run = Run {
        incarnation: incarnation.clone(),
        config,
        dir: &dir,
        task,
        agent,
        examples,
        held_out,
        scores,
        past,
        checkpoint_every,
    };
    let (tx, events) = mpsc::unbounded_channel();
    let threads = Threads::start(run, &metrics, &health, &Events(tx))?;
    carrier.set(threads.carrier().clone()).ok();
    let main_loop = MainLoop {
        incarnation,
        run_dir: dir.clone(),
        display: Display::start(metrics.clone(), experiment.total_steps()),
        metrics,
        metrics_address: server.address.to_string(),
        endpoints: outside.endpoints,
        events,
        threads,
        beat: health.register("main", STUCK),
        health,
        evaluators: outside.evaluators,
        environment: experiment.environment.clone(),
    };
    Ok((dir, main_loop.run(opening).await))
}

/// The agent, which begins with the checkpoint of `--from`, what it learns from, and its metrics on
/// held-out episodes.
fn begin_agent(
    config: &RunConfig,
    data: Split,
    first: Option<&Checkpoint>,
) -> anyhow::Result<(Agent, Examples, Option<HeldOut>)> {
    let experiment = &config.experiment;
    let (mut agent, examples) = begin(experiment, config.run.device, data.training)?;
    if let Some(Checkpoint { state, .. }) = first {
        let loaded =
            agent.load(state).hint("networks stay as they are: leave out what changes them");
        loaded.context("the last checkpoint of --from does not fit")?;
    }
    let held_out = data.held_out.and_then(|episodes| HeldOut::new(experiment, episodes, &agent));
    Ok((agent, examples, held_out))
}

/// The run in the folder, or a new one; without a checkpoint of its own it begins with `first`.
fn open_or_create(
    path: &Path,
    (begun, first): (Option<ExistingRun>, Option<Checkpoint>),
    fresh: bool,
    config: &RunConfig,
) -> anyhow::Result<(RunDir, Log, ResumePoint)> {
    let (dir, scores, mut past) = match begun {
        Some(begun) if !fresh => begun.resume(&config.experiment)?,
        begun => {
            begun.map_or(Ok(()), ExistingRun::set_aside)?;
            let (dir, scores) = RunDir::create(path, config)?;
            (dir, scores, ResumePoint::default())
        }
    };
    if past.checkpoint.is_none()
        && let Some(first) = first
    {
        dir.write_checkpoint(&first)?;
        past.checkpoint = Some(first);
    }
    Ok((dir, scores, past))
}

/// Milliseconds since 1970.
fn now() -> anyhow::Result<u64> {
    Ok(SystemTime::now().duration_since(UNIX_EPOCH)?.as_millis() as u64)
}

/// Writes the report after any ending; a run that did not complete is an error.
fn conclude(
    runtime: &Runtime,
    run_dir: &RunDir,
    config: &RunConfig,
    ending: Ending,
) -> anyhow::Result<()> {
    let folder = run_dir.path().display();
    let kept = format!(
        "everything up to the newest checkpoint is kept in {folder}; the same command continues from there"
    );
    let (steps, environment) = (config.experiment.total_steps(), &config.experiment.environment);
    let error = match ending {
        Ending::Complete => match summarize(run_dir)?.episodes_missing {
            0 => return Ok(()),
            missing => {
                return Err(hinted(
                    anyhow!(
                        "training is complete, without the scores of {}",
                        counted(missing as usize, "episode")
                    ),
                    "the log says why; fix it, and the same command hands them out again",
                ));
            }
        },
        Ending::Failed(error) => hinted(error, kept),
        Ending::Interrupted => unfinished(
            anyhow!("interrupted before the end of {steps} steps and their evaluations"),
            kept,
        ),
        Ending::Unscored => unfinished(
            anyhow!(
                "training is complete, but no evaluator came that has the environment {environment}"
            ),
            "start one and give the same command again, which waits for the scores; or let the learner start some, by \
             --evaluators N",
        ),
    };
    // The disk may hang, and after a signal there is little time.
    let dir = run_dir.clone();
    let report = runtime.spawn_blocking(move || summarize(&dir));
    let report = async { anyhow::Ok(timeout(REPORT_PATIENCE, report).await???) };
    if let Err(error) = runtime.block_on(report) {
        warn!("the run has no report: {error:#}");
    }
    Err(error)
}

fn summarize(run_dir: &RunDir) -> anyhow::Result<RunReport> {
    let report = RunReport::read(run_dir.path())?;
    let mut text = String::new();
    if !report.evaluations.is_empty() {
        run_dir.write_json("report.json", &report)?;
        let picture = run_dir.path().join("learning_curve.svg");
        let svg = learning_curve(&report).svg()?;
        files::replace(&picture, svg.as_bytes())
            .with_context(|| format!("cannot write {}", picture.display()))?;
        let (scores, picture) = (report.text(), picture.display());
        text = format!("\n{scores}\nlearning curve: {picture}\n");
    }
    print(&format!("{text}run folder: {}", run_dir.path().display()))?;
    Ok(report)
}

/// The run's name: the folder's name, which is also part of its Zenoh keys.
fn run_name(path: &Path) -> anyhow::Result<Name> {
    let folder = path.file_name().unwrap_or_default().to_string_lossy();
    Name::new(folder)
        .with_context(|| format!("the run folder {path:?} gives no name for the run"))
        .hint(
            "name a folder by --run-dir, whose last part is 1 to 64 letters, digits, dots, dashes or underscores",
        )
}

fn run_config(
    args: &TrainArgs,
    name: &Name,
    task: &str,
    experiment: Experiment,
    hashes: Vec<String>,
    data: &Split,
) -> anyhow::Result<RunConfig> {
    let statistics = data.training.statistics();
    let cpu = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let cpu = cpu.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    let cpu = cpu.map_or(std::env::consts::ARCH, |(_, name)| name.trim());
    let threads = counted(rayon::current_num_threads(), "thread");
    let mut files = data.files.clone();
    for (file, sha256) in files.iter_mut().zip(hashes) {
        file.sha256 = Some(sha256);
    }
    Ok(RunConfig {
        run: RunInfo {
            name: name.clone(),
            started: now()?,
            task: task.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            machine: Some(format!("{cpu}, {threads}, {}", experiment.precision.arithmetic())),
            device: args.device,
        },
        dataset: DatasetInfo {
            transitions: statistics.transitions as u64,
            episodes: statistics.episodes as u64,
            held_out: data.episodes.clone(),
            min_return: statistics.return_min,
            mean_return: statistics.return_mean,
            max_return: statistics.return_max,
            mean_score: statistics.score_mean,
            files,
        },
        experiment,
    })
}
