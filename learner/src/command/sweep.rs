//! `learner sweep`, from the parsed command line to the summary of all runs.

use std::collections::{BTreeMap, VecDeque};
use std::fmt::Alignment::{Left, Right};
use std::fs;
use std::path::{Path, PathBuf};
use std::thread::available_parallelism;

use anyhow::{Context, anyhow};
use quad_run::folder::{Lock, RunDirError};
use quad_run::status::State;
use quad_run::table::{Style, Table};
use quad_runtime::{
    Hint, SessionError, hinted, open_router, print, stay_in_background, threads_asked, unfinished,
};
use tracing::{info, warn};

use super::all_readable;
use crate::cli::SweepArgs;
use crate::local_evaluators::LocalEvaluators;
use crate::sweep::{Cost, Ended, Learners, PlannedRun, Study, Sweep};

/// Runs and their states.
type Runs = Vec<(PlannedRun, State)>;

/// Runs the sweep; a run that is not complete is an error.
pub fn sweep(args: &SweepArgs) -> anyhow::Result<()> {
    let study = Study::read(&args.study, &args.only, &args.set)?;
    let folder = args.runs.join(&study.name);
    let runs = chosen(&study, args, &folder)?;
    if args.list {
        print(&list(&runs))?;
        return all_readable(runs.iter().filter(|(_, state)| *state == State::Unreadable).count());
    }
    info!("{}: {}", study.name, study.about);
    let count = runs.len();
    let left: Runs = runs.into_iter().filter(|(_, state)| *state != State::Complete).collect();
    let complete = count - left.len();
    let (unreadable, left): (Runs, Runs) =
        left.into_iter().partition(|(_, state)| *state == State::Unreadable);
    let begun = left.iter().filter(|(_, state)| *state != State::NotBegun).count();
    info!("{count} runs: {complete} complete, {} to do, of which {begun} have begun", left.len());
    let mut ended =
        if left.is_empty() { Ended::default() } else { work(args, &study.name, &folder, left)? };
    ended.failed.extend(
        unreadable.iter().map(|(run, _)| format!("{}: its folder cannot be read", run.name)),
    );
    conclude(&folder, count, ended)
}

/// Keeps others from the study's folder, or from the whole study if this is a part of it: two
/// sweeps of the same runs would start them twice.
fn lock(args: &SweepArgs, folder: &Path) -> anyhow::Result<Lock> {
    fs::create_dir_all(folder)
        .with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let path = folder.join("sweep.lock");
    let is_part = args.index.is_some() || args.shard.is_some() || !args.only.is_empty();
    let lock = if is_part { Lock::share(&path) } else { Lock::take(&path) };
    let hint =
        "wait for its end; --list prints how far it is, --shard shares a study among machines";
    lock.map_err(|error| match error {
        in_use @ RunDirError::InUse(_) => unfinished(in_use, hint),
        other => other.into(),
    })
}

/// The runs that the command line selects, and their states.
fn chosen(study: &Study, args: &SweepArgs, folder: &Path) -> anyhow::Result<Runs> {
    if let Some(index) = args.index.filter(|index| study.runs.iter().all(|run| run.index != *index))
    {
        return Err(hinted(anyhow!("there is no run {index}"), "--list prints them"));
    }
    let is_chosen = |(place, run): &(usize, &PlannedRun)| {
        args.index.is_none_or(|index| run.index == index)
            && args.shard.is_none_or(|shard| shard.has(*place))
    };
    let with_state =
        |(_, run): (usize, &PlannedRun)| Ok((run.clone(), run.state(&folder.join(&run.name))?));
    study.runs.iter().enumerate().filter(is_chosen).map(with_state).collect()
}

fn list(runs: &Runs) -> String {
    let mut table = Table::new(&[("index", Right), ("run", Left), ("state", Left)]);
    for (PlannedRun { index, name, experiment, .. }, state) in runs {
        table.push([index.to_string(), name.clone(), state.text(experiment.steps)]);
    }
    table.render(Style::Text)
}

/// How the runs share the machine.
struct Machine {
    /// Runs at a time.
    jobs: usize,
    /// Threads of each learner.
    threads: usize,
    /// The evaluators of all runs.
    evaluators: LocalEvaluators,
}

impl Machine {
    /// The shares for `runs` runs. What the command line does not say follows from the cores that
    /// this process may use.
    fn share(args: &SweepArgs, runs: usize) -> anyhow::Result<Self> {
        let cores = available_parallelism()?.get();
        let threads = threads_asked().map_or(1, usize::from);
        let (jobs, left) = shares(cores, threads, args.jobs, runs);
        let count = if args.connect.is_some() { 0 } else { args.evaluators.unwrap_or(left) };
        Ok(Self { jobs, threads, evaluators: LocalEvaluators::new(count, left)? })
    }
}

/// How many learners of so many threads run at a time, and how many cores that leaves for
/// evaluators.
fn shares(cores: usize, threads: usize, jobs: Option<u16>, runs: usize) -> (usize, usize) {
    let jobs = jobs.map_or(cores * 3 / 4 / threads, usize::from).clamp(1, runs);
    (jobs, cores.saturating_sub(jobs.saturating_mul(threads)).max(1))
}

fn work(args: &SweepArgs, study: &str, folder: &Path, left: Runs) -> anyhow::Result<Ended> {
    let Machine { jobs, threads, mut evaluators } = Machine::share(args, left.len())?;
    // Here once, not in each learner.
    let mut datasets = BTreeMap::<Option<String>, Option<PathBuf>>::new();
    for (run, _) in &left {
        datasets.entry(run.experiment.dataset.clone()).or_insert_with(|| {
            let refused = |error| warn!("no run on the data of {} can begin: {error:#}", run.name);
            run.source.obtain().map_err(refused).map(|dataset| dataset.path).ok()
        });
    }
    let mut step_seconds = BTreeMap::new();
    // A single run, such as a task of an array job, starts at once and prints its own forecast.
    if args.index.is_none() {
        let cost = Cost::measure(&left, |run| datasets[&run.experiment.dataset].as_deref())?;
        info!("{}", cost.text(jobs));
        step_seconds = cost.step_seconds;
    }
    let _lock = lock(args, folder)?;
    // Tasks of an array job must not write into each other's logs.
    let logs = args.index.map_or(folder.to_owned(), |_| folder.join(&left[0].0.name));
    fs::create_dir_all(&logs)
        .with_context(|| format!("cannot make the folder {}", logs.display()))?;

    let mut runtime = tokio::runtime::Builder::new_multi_thread();
    let runtime =
        runtime.worker_threads(2).on_thread_start(stay_in_background).enable_all().build()?;
    let ended = runtime.block_on(async {
        let (_router, endpoint) = match args.connect.clone() {
            Some(endpoint) => (None, endpoint),
            None => {
                open_router().await.map(|(router, endpoint)| (Some(router), endpoint)).hint_of(SessionError::hint)?
            }
        };
        evaluators.start(std::slice::from_ref(&endpoint), &logs, study)?;
        info!(
            "{jobs} at a time; learners and evaluators meet at {endpoint}; logs are {}/RUN/learner.log",
            folder.display()
        );
        let (folder, waiting) = (folder.to_owned(), VecDeque::from(left));
        let learners = Learners { threads, endpoint, http: args.http };
        anyhow::Ok(Sweep { folder, waiting, jobs, learners, evaluators, step_seconds }.run().await)
    });
    runtime.shutdown_background();
    ended
}

/// Prints how all runs have ended.
fn conclude(folder: &Path, count: usize, ended: Ended) -> anyhow::Result<()> {
    let Ended { unfinished: stopped, failed } = ended;
    if !failed.is_empty() {
        let error =
            anyhow!("{} of {count} runs have failed:\n  {}", failed.len(), failed.join("\n  "));
        return Err(error).hint("fix it and run the same command: unfinished runs continue");
    }
    if stopped > 0 {
        let kept = "what they have reached is kept, and the same command continues from there";
        return Err(unfinished(anyhow!("{stopped} of {count} runs are not complete"), kept));
    }
    print(&format!("all {count} runs are complete: learner report {}", folder.display()))
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::cli::{Cli, Command};

    #[test]
    fn learners_and_evaluators_share_the_cores_however_many_threads_are_asked_for() {
        assert_eq!(shares(16, 1, None, 20), (12, 4));
        assert_eq!(shares(16, 2, None, 20), (6, 4));
        assert_eq!(shares(1, 1, None, 20), (1, 1));
        assert_eq!(shares(16, 1, Some(40), 20), (20, 1));
        assert_eq!(shares(16, usize::MAX, Some(2), 20), (2, 1));
    }

    #[test]
    fn shards_share_the_runs_that_the_command_line_keeps_to() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.toml");
        let text = "about = 'x'\nrun = { task = 'hopper-demo', dataset = 'x.hdf5' }\n\
                    axes = { seed = [0, 1, 2], batch_size = [8, 16] }";
        fs::write(&path, text).unwrap();
        let path = path.to_str().unwrap();
        let of_shard = |shard: &str| {
            let words = ["learner", "sweep", path, "--only", "batch_size=16", "--shard", shard];
            let Command::Sweep(args) = Cli::try_parse_from(words).unwrap().command else {
                panic!("{words:?}")
            };
            let study = Study::read(&args.study, &args.only, &args.set).unwrap();
            Vec::from_iter(
                chosen(&study, &args, folder.path()).unwrap().iter().map(|(run, _)| run.index),
            )
        };
        assert_eq!([of_shard("1/2"), of_shard("2/2")], [vec![1, 5], vec![3]]);
    }
}
