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
use tokio::sync::mpsc;
use tokio::task::LocalSet;
use tracing::{info, warn};

use super::all_readable;
use crate::cli::SweepArgs;
use crate::local_evaluators::LocalEvaluators;
use crate::sweep::{Cost, LearnerOptions, Outcome, PlannedRun, Study, Sweep};

type Runs = Vec<(PlannedRun, State)>;

pub fn sweep(args: &SweepArgs) -> anyhow::Result<()> {
    let study = Study::read(&args.study, &args.only, &args.set)?;
    let folder = args.runs.join(&study.name);
    let runs = chosen(&study, args, &folder)?;
    let split = |runs: Runs, state| -> (Runs, Runs) {
        runs.into_iter().partition(|(_, found)| *found == state)
    };
    let (count, listed) = (runs.len(), args.list.then(|| list(&runs)));
    let (unreadable, runs) = split(runs, State::Unreadable);
    if let Some(text) = listed {
        print(&text)?;
        return all_readable(unreadable.len());
    }
    info!("{}: {}", study.name, study.about);
    let (complete, left) = split(runs, State::Complete);
    let begun = left.iter().filter(|(_, state)| *state != State::NotBegun).count();
    let (complete, todo) = (complete.len(), left.len());
    info!("{count} runs: {complete} complete, {todo} to do, of which {begun} have begun");
    let mut ended = match todo {
        0 => Outcome::default(),
        _ => work(args, &study.name, &folder, left)?,
    };
    for (run, _) in unreadable {
        ended.failed.push(format!("{}: its folder cannot be read", run.name));
    }
    conclude(&folder, count, ended)
}

/// Makes a folder.
fn make(folder: &Path) -> anyhow::Result<()> {
    let failed = || format!("cannot make the folder {}", folder.display());
    fs::create_dir_all(folder).with_context(failed)
}

/// Keeps others from the study's folder, or from the whole study if this is a part of it: two
/// sweeps of the same runs would start them twice.
fn lock(args: &SweepArgs, folder: &Path) -> anyhow::Result<Lock> {
    make(folder)?;
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
    let mut chosen = Runs::new();
    for (place, run) in study.runs.iter().enumerate() {
        if args.index.is_none_or(|index| run.index == index)
            && args.shard.is_none_or(|shard| shard.has(place))
        {
            chosen.push((run.clone(), run.state(&folder.join(&run.name))?));
        }
    }
    match args.index {
        Some(index) if chosen.is_empty() => {
            Err(hinted(anyhow!("there is no run {index}"), "--list prints them"))
        }
        _ => Ok(chosen),
    }
}

fn list(runs: &Runs) -> String {
    let mut table = Table::new(&[("index", Right), ("run", Left), ("state", Left)]);
    for (PlannedRun { index, name, experiment, .. }, state) in runs {
        table.push([index.to_string(), name.clone(), state.text(experiment.total_steps())]);
    }
    table.render(Style::Text)
}

/// The number of learners at a time, and of cores that they leave to evaluators.
fn shares(cores: usize, threads: usize, jobs: Option<u16>, runs: usize) -> (usize, usize) {
    let jobs = jobs.map_or(cores * 3 / 4 / threads, usize::from).clamp(1, runs);
    (jobs, cores.saturating_sub(jobs.saturating_mul(threads)).max(1))
}

fn work(args: &SweepArgs, study: &str, folder: &Path, left: Runs) -> anyhow::Result<Outcome> {
    let threads = threads_asked().map_or(1, usize::from);
    let (jobs, cores) = shares(available_parallelism()?.get(), threads, args.jobs, left.len());
    let count = if args.connect.is_some() { 0 } else { args.evaluators.unwrap_or(cores) };
    let mut evaluators = LocalEvaluators::new(count, cores)?;
    // Fetched once, not by each learner.
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
    make(&logs)?;

    let mut runtime = tokio::runtime::Builder::new_multi_thread();
    let runtime =
        runtime.worker_threads(2).on_thread_start(stay_in_background).enable_all().build()?;
    let ended = runtime.block_on(async {
        // Outside the `LocalSet`, in which Zenoh may not block its thread.
        let (_router, endpoint) = match args.connect.clone() {
            Some(endpoint) => (None, endpoint),
            None => {
                let (router, endpoint) = open_router().await.hint_of(SessionError::hint)?;
                (Some(router), endpoint)
            }
        };
        info!(
            "{jobs} at a time; learners and evaluators meet at {endpoint}; logs are {}/RUN/learner.log",
            folder.display()
        );
        let (tx, lines) = mpsc::unbounded_channel();
        let report = move |line| drop(tx.send(line));
        let work = async {
            evaluators.start(std::slice::from_ref(&endpoint), &logs, study, report)?;
            let (folder, waiting) = (folder.to_owned(), VecDeque::from(left));
            let options = LearnerOptions { threads, endpoint, http: args.http };
            let sweep = Sweep { folder, waiting, jobs, options, evaluators, lines, step_seconds };
            anyhow::Ok(sweep.run().await)
        };
        LocalSet::new().run_until(work).await
    });
    runtime.shutdown_background();
    ended
}

fn conclude(folder: &Path, count: usize, ended: Outcome) -> anyhow::Result<()> {
    let Outcome { unfinished: stopped, failed } = ended;
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
    fn learners_and_evaluators_share_the_cores() {
        assert_eq!(shares(16, 1, None, 20), (12, 4));
        assert_eq!(shares(16, 2, None, 20), (6, 4));
        assert_eq!(shares(1, 1, None, 20), (1, 1));
        assert_eq!(shares(16, 1, Some(40), 20), (20, 1));
        assert_eq!(shares(16, usize::MAX, Some(2), 20), (2, 1));
    }

    #[test]
    fn shards_share_the_selected_runs() {
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
