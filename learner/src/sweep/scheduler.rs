//! Runs a limited number of learners at a time, until every run has ended.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::pin::pin;
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use quad_run::status::{Pace, State};
use quad_runtime::{LEAVE_WITHIN, clean};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time;
use tokio_util::sync::CancellationToken;
use tracing::info;

use super::learner_process::{End, LearnerOptions, LearnerProcess};
use super::study::PlannedRun;
use crate::children::LocalEvaluators;

pub(crate) struct Sweep {
    pub folder: PathBuf,
    pub waiting: VecDeque<(PlannedRun, State)>,
    /// Runs at a time.
    pub jobs: usize,
    pub options: LearnerOptions,
    pub evaluators: LocalEvaluators,
    /// Reports of the evaluators.
    pub lines: mpsc::UnboundedReceiver<String>,
    /// Estimated seconds of a gradient step, by the run's index; 1 if there is no estimate.
    pub step_seconds: BTreeMap<usize, f64>,
}

#[derive(Default)]
pub(crate) struct Outcome {
    /// Number of runs that the same command continues.
    pub unfinished: usize,
    pub failed: Vec<String>,
}

#[derive(Default)]
struct Progress {
    /// Learners and their last known progress, by the run's index.
    running: BTreeMap<usize, (LearnerProcess, Pace)>,
    complete: usize,
    failed: Vec<String>,
    /// Estimated seconds of the work that learners have done that have ended.
    done: f64,
}

impl Sweep {
    /// Runs all learners. After a signal to end, running ones save checkpoints. Needs a `LocalSet`
    /// on the main thread: the system ends the learners with their thread.
    pub async fn run(mut self) -> Outcome {
        let mut shutdown = pin!(quad_runtime::shutdown_signal(2 * LEAVE_WITHIN));
        let stop = CancellationToken::new();
        let (count, display) = (self.waiting.len(), display());
        let seconds = if display.is_hidden() { 30 } else { 1 };
        let mut ticker = time::interval(Duration::from_secs(seconds));
        ticker.tick().await; // The first tick is immediate.
        let (mut progress, begin) = (Progress::default(), Instant::now());
        let (mut learners, mut reading) = (JoinSet::new(), JoinSet::new());
        loop {
            while learners.len() < self.jobs
                && let Some((run, state)) = self.waiting.pop_front()
            {
                let learner = LearnerProcess::new(run, state, &self.folder);
                let pace = Pace { step: learner.from, ..Pace::default() };
                progress.running.insert(learner.run.index, (learner.clone(), pace));
                learners.spawn_local(learner.run(self.options.clone(), stop.clone()));
            }
            if learners.is_empty() {
                break;
            }
            tokio::select! {
                // A hanging disk keeps the last lines.
                _ = ticker.tick(), if reading.is_empty() => {
                    let running = progress.running.iter();
                    let dirs = running.map(|(index, (learner, _))| (*index, learner.dir.clone()));
                    let dirs = Vec::from_iter(dirs);
                    let read = |(index, dir): (usize, PathBuf)| (index, Pace::read(&dir));
                    reading.spawn_blocking(move || Vec::from_iter(dirs.into_iter().map(read)));
                }
                Some(line) = self.lines.recv() => print(&display, &line),
                Some(Ok((learner, end, pace))) = learners.join_next() => {
                    print(&display, &self.conclude(&learner, end, pace, &mut progress));
                }
                Some(Ok(paces)) = reading.join_next() => {
                    for (index, pace) in paces {
                        progress.running.entry(index).and_modify(|(_, last)| *last = pace);
                    }
                    show(&display, &self.lines(&progress, begin.elapsed()));
                }
                () = &mut shutdown, if !stop.is_cancelled() => {
                    print(&display, "stopping; the runs at work save their checkpoints");
                    self.waiting.clear();
                    stop.cancel();
                }
            }
        }
        display.finish_and_clear();
        self.evaluators.end().await;
        let unfinished = count - progress.complete - progress.failed.len();
        Outcome { unfinished, failed: progress.failed }
    }

    /// Records the end of a learner, and describes it.
    fn conclude(
        &self,
        learner: &LearnerProcess,
        end: End,
        pace: Pace,
        progress: &mut Progress,
    ) -> String {
        let LearnerProcess { run, from, .. } = learner;
        progress.running.remove(&run.index);
        progress.done += self.seconds(run, *from, pace.step);
        match end {
            End::Complete => {
                progress.complete += 1;
                let score = pace.score.map(|(_, score)| format!(", last score {score:.1}"));
                format!("{} is complete{}", run.name, score.unwrap_or_default())
            }
            End::Unfinished => format!("{} has stopped; the same command continues", run.name),
            End::Failed(reason) => {
                progress.failed.push(reason.clone());
                format!("failed: {reason}")
            }
        }
    }

    fn lines(&self, progress: &Progress, elapsed: Duration) -> Vec<String> {
        let Progress { running, complete, failed, .. } = progress;
        let (mut lines, mut done, mut left) = (Vec::new(), progress.done, 0.0);
        for (LearnerProcess { run, from, .. }, pace) in running.values() {
            let steps = run.experiment.total_steps();
            done += self.seconds(run, *from, pace.step);
            left += self.seconds(run, pace.step, steps);
            lines.push(format!("{}: step {}/{steps}, {pace}", run.name, pace.step));
        }
        for (run, state) in &self.waiting {
            let steps = run.experiment.total_steps();
            left += self.seconds(run, state.step(steps), steps);
        }
        let (running, waiting) = (running.len(), self.waiting.len());
        let mut total = format!("runs: {complete} complete, {running} at work, {waiting} waiting");
        if !failed.is_empty() {
            total += &format!(", {} failed", failed.len());
        }
        if done > 0.0 {
            let left = HumanDuration(elapsed.mul_f64(left / done));
            total += &format!(", {left} left");
        }
        lines.push(total);
        lines
    }

    /// Estimated seconds from one step of a run to another.
    fn seconds(&self, run: &PlannedRun, from: u64, to: u64) -> f64 {
        let each = self.step_seconds.get(&run.index).copied();
        to.saturating_sub(from) as f64 * each.unwrap_or(1.0)
    }
}

/// A line for each running learner and a total on a terminal; hidden where stderr is none.
fn display() -> ProgressBar {
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
    // The default style shows the message, too.
    match ProgressStyle::with_template("{msg}") {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}

fn print(display: &ProgressBar, text: &str) {
    if display.is_hidden() { info!("{text}") } else { display.println(clean(text)) }
}

/// Replaces the lines on a terminal.
fn show(display: &ProgressBar, lines: &[String]) {
    if display.is_hidden() {
        lines.iter().for_each(|line| info!("{line}"));
    } else {
        display.set_message(lines.join("\n"));
    }
}
