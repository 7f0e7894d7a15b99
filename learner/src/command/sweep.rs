//! `learner sweep`, from the parsed command line to the summary of all runs.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt::Alignment::{Left, Right};
use std::fs;
use std::path::{Path, PathBuf};
use std::thread::available_parallelism;

use anyhow::{Context, anyhow};
use quad_run::counted;
use quad_run::folder::{Lock, RunDirError};
use quad_run::status::State;
use quad_run::table::{Column, Style, Table};
use quad_runtime::{Hint, SessionError, open_router, print, requested_threads, unfinished};
use tokio::sync::mpsc;
use tokio::task::LocalSet;
use tracing::{info, warn};

use super::all_readable;
use super::dataset_hints::record_hint;
use crate::children::LocalEvaluators;
use crate::cli::SweepArgs;
use crate::data;
use crate::sweep::{LearnerOptions, Outcome, PlannedRun, Study, StudyCost, Sweep};

type Runs = Vec<(PlannedRun, State)>;

pub fn sweep(args: &SweepArgs) -> anyhow::Result<()> {
    let study = Study::read(&args.study, &args.only, &args.set)?;
    let folder = args.runs.join(&study.name);
    let mut runs = chosen(&study, args, &folder)?;
    let count = |state| runs.iter().filter(|(_, reached)| *reached == state).count();
    let [complete, unreadable, new] =
        [State::Complete, State::Unreadable, State::NotBegun].map(count);
    if args.list {
        print(&list(&runs))?;
        return all_readable(unreadable);
    }
    info!("{}: {}", study.name, study.about);
    let (total, todo) = (runs.len(), runs.len() - complete - unreadable);
    let begun = todo - new;
    info!("{}: {complete} complete, {todo} to do ({begun} begun)", counted(total, "run"));
    let mut failed = Vec::new();
    for (run, _) in runs.iter().filter(|(_, state)| *state == State::Unreadable) {
        failed.push(format!("{}: its folder cannot be read", run.name));
    }
    runs.retain(|(_, state)| !matches!(state, State::Complete | State::Unreadable));
    for doubt in BTreeSet::from_iter(runs.iter().flat_map(|(run, _)| &run.doubts)) {
        warn!("{doubt}");
    }
    let mut ended = match todo {
        0 => Outcome::default(),
        _ => work(args, &study.name, &folder, runs)?,
    };
    ended.failed.extend(failed);
    conclude(&folder, total, ended)
}

/// Keeps others from the study's folder, or from the whole study if this is a part of it: two
/// sweeps of the same runs would start them twice.
fn lock(args: &SweepArgs, folder: &Path) -> anyhow::Result<Lock> {
    let path = folder.join("sweep.lock");
    let is_part = args.index.is_some() || args.shard.is_some() || !args.only.is_empty();
    let take = if is_part { Lock::share } else { Lock::take };
    let hint =
        "wait for its end; --list prints how far it is, --shard shares a study among machines";
    take(&path).map_err(|error| match error {
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
    if let Some(index) = args.index.filter(|_| chosen.is_empty()) {
        return Err(anyhow!("there is no run {index}")).hint("--list prints them");
    }
    Ok(chosen)
}

fn list(runs: &Runs) -> String {
    let columns: [Column<(PlannedRun, State)>; 3] = [
        ("index", Right, |(run, _)| run.index.to_string()),
        ("run", Left, |(run, _)| run.name.clone()),
        ("state", Left, |(run, state)| state.text(run.experiment.total_steps())),
    ];
    Table::from_rows(runs, &columns).render(Style::Text)
}

/// The number of learners at a time, and of cores that they leave to evaluators.
fn shares(cores: usize, threads: usize, jobs: Option<u16>, runs: usize) -> (usize, usize) {
    let jobs = jobs.map_or(cores * 3 / 4 / threads, usize::from);
    let jobs = jobs.clamp(1, runs);
    let left = cores.saturating_sub(jobs.saturating_mul(threads));
    (jobs, left.max(1))
}

/// The files of each run's data, by their names; `None` where there is none.
type Datasets = BTreeMap<Vec<String>, Option<Vec<PathBuf>>>;

/// Fetches each dataset once, in place of each learner. Fails if no run of several can begin.
fn obtain(left: &Runs, is_alone: bool) -> anyhow::Result<Datasets> {
    let (mut datasets, mut refusal) = (Datasets::new(), None);
    for (run, _) in left {
        let fetch = || {
            let files = data::obtain(&run.sources).hint(record_hint(&run.experiment));
            let refused = |error| {
                warn!("no run on the data of {} can begin: {error:#}", run.name);
                refusal = Some(error);
            };
            files.map_err(refused).ok().map(|(paths, _)| paths)
        };
        datasets.entry(run.experiment.dataset.clone()).or_insert_with(fetch);
    }
    match refusal {
        Some(refusal) if !is_alone && datasets.values().all(Option::is_none) => {
            Err(refusal.context("no run can begin"))
        }
        _ => Ok(datasets),
    }
}

fn work(args: &SweepArgs, study: &str, folder: &Path, left: Runs) -> anyhow::Result<Outcome> {
    let threads = requested_threads().map_or(1, usize::from);
    let cores = available_parallelism()?.get();
    let (jobs, cores) = shares(cores, threads, args.jobs, left.len());
    let count = match (&args.connect, args.evaluators) {
        (Some(_), _) => 0,
        (None, Some(count)) => count,
        (None, None) => {
            let is_played = left.iter().any(|(run, _)| run.experiment.needs_evaluators());
            if is_played { cores } else { 0 }
        }
    };
    let mut evaluators = LocalEvaluators::new(count, cores)?;
    let datasets = obtain(&left, args.index.is_some())?;
    let mut step_seconds = BTreeMap::new();
    // A single run, such as a task of an array job, starts at once and prints its own forecast.
    if args.index.is_none() {
        let cost = StudyCost::measure(&left, |run| datasets[&run.experiment.dataset].as_deref())?;
        info!("{}", cost.text(jobs));
        step_seconds = cost.step_seconds;
    }
    // Tasks of an array job must not write into each other's logs.
    let logs = folder.join(args.index.map_or("", |_| &*left[0].0.name));
    fs::create_dir_all(&logs)
        .with_context(|| format!("cannot make the folder {}", folder.display()))
        .hint("choose another folder: learner sweep STUDY.toml DIR")?;
    let _lock = lock(args, folder)?;

    let runtime = super::runtime()?;
    let ended = runtime.block_on(async {
        // Outside the `LocalSet`, in which Zenoh may not block its thread.
        let (_router, endpoint) = match args.connect.clone() {
            Some(endpoint) => (None, endpoint),
            None => {
                let (router, endpoint) = open_router().await.hint_of(SessionError::hint)?;
                (Some(router), endpoint)
            }
        };
        let shown = folder.display();
        info!(
            "{jobs} at a time; learners and evaluators meet at {endpoint}; logs are {shown}/RUN/learner.log"
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
    let (stopped, failed, runs) = (ended.unfinished, ended.failed.len(), counted(count, "run"));
    if failed > 0 {
        let reasons = ended.failed.join("\n  ");
        return Err(anyhow!("{failed} of {runs} failed:\n  {reasons}"))
            .hint("fix it and run the same command: unfinished runs continue");
    }
    if stopped > 0 {
        let error = anyhow!("{stopped} of {runs} did not complete");
        let kept = "what they have reached is kept, and the same command continues from there";
        return Err(unfinished(error, kept));
    }
    print(&format!("{runs} complete: learner report {}", folder.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn learners_and_evaluators_share_the_cores() {
        assert_eq!(shares(16, 1, None, 20), (12, 4));
        assert_eq!(shares(16, 2, None, 20), (6, 4));
        assert_eq!(shares(1, 1, None, 20), (1, 1));
        assert_eq!(shares(16, 1, Some(40), 20), (20, 1));
        assert_eq!(shares(16, usize::MAX, Some(2), 20), (2, 1));
    }
}
