//! The work of a sweep: so many learners at a time, until every run has ended.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::pin::pin;
use std::time::{Duration, Instant};

use indicatif::HumanDuration;
use quad_run::status::{Pace, State};
use quad_runtime::LEAVE_WITHIN;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::interval;
use tokio_util::sync::CancellationToken;

use super::display::Display;
use super::learner_process::{End, LearnerProcess, Learners};
use super::study::PlannedRun;
use crate::local_evaluators::LocalEvaluators;

/// How often the display is updated.
const TICK: Duration = Duration::from_millis(100);

/// What is to be done.
pub(crate) struct Sweep {
    /// Folder of the study.
    pub folder: PathBuf,
    /// The runs that are not complete.
    pub waiting: VecDeque<(PlannedRun, State)>,
    /// How many run at a time.
    pub jobs: usize,
    /// How they are started.
    pub learners: Learners,
    pub evaluators: LocalEvaluators,
    /// Reports of the evaluators.
    pub lines: mpsc::UnboundedReceiver<String>,
    /// Seconds of a gradient step, by the run's number; without one, all are taken to be the same.
    pub step_seconds: BTreeMap<usize, f64>,
}

/// How the runs have ended.
#[derive(Default)]
pub(crate) struct Ended {
    /// Runs that the same command continues.
    pub unfinished: usize,
    /// What went wrong, a sentence for each run that has failed.
    pub failed: Vec<String>,
}

/// What is going on.
struct Floor {
    /// By the run's number, with what each was last seen to have done.
    at_work: BTreeMap<usize, (LearnerProcess, Pace)>,
    complete: usize,
    failed: Vec<String>,
    display: Display,
    begin: Instant,
    /// Estimated seconds of work that learners which have ended have done.
    done: f64,
}

impl Sweep {
    /// Runs all learners. After a signal to end, those at work save checkpoints. Needs a `LocalSet`
    /// on the main thread: the system ends the learners with their thread.
    pub async fn run(mut self) -> Ended {
        let mut shutdown = pin!(quad_runtime::shutdown_signal(2 * LEAVE_WITHIN));
        let stop = CancellationToken::new();
        let mut ticker = interval(TICK);
        let count = self.waiting.len();
        let mut floor = Floor {
            at_work: BTreeMap::new(),
            complete: 0,
            failed: Vec::new(),
            display: Display::start(),
            begin: Instant::now(),
            done: 0.0,
        };
        let (mut learners, mut reading) = (JoinSet::new(), JoinSet::new());
        loop {
            while learners.len() < self.jobs
                && let Some((run, state)) = self.waiting.pop_front()
            {
                let learner = LearnerProcess::new(run, state, &self.folder);
                let begun = Pace { step: learner.from, ..Pace::default() };
                floor.at_work.insert(learner.run.index, (learner.clone(), begun));
                learners.spawn_local(learner.run(self.learners.clone(), stop.clone()));
            }
            if learners.is_empty() {
                break;
            }
            tokio::select! {
                _ = ticker.tick() => {
                    if floor.display.is_due() {
                        match reading.is_empty() {
                            true => drop(reading.spawn_blocking(read(&floor))),
                            false => floor.display.show(&self.lines(&floor)),
                        }
                    }
                }
                Some(line) = self.lines.recv() => floor.display.say(&line),
                Some(Ok((learner, end, pace))) = learners.join_next() => {
                    self.conclude(&learner, end, pace, &mut floor);
                }
                Some(Ok(progress)) = reading.join_next() => {
                    for (index, pace) in progress {
                        floor.at_work.entry(index).and_modify(|(_, known)| *known = pace);
                    }
                    floor.display.show(&self.lines(&floor));
                }
                () = &mut shutdown, if !stop.is_cancelled() => {
                    floor.display.say("stopping; the runs at work save their checkpoints");
                    self.waiting.clear();
                    stop.cancel();
                }
            }
        }
        floor.display.finish();
        self.evaluators.end().await;
        Ended { unfinished: count - floor.complete - floor.failed.len(), failed: floor.failed }
    }

    fn conclude(&self, learner: &LearnerProcess, end: End, pace: Pace, floor: &mut Floor) {
        let name = &learner.run.name;
        floor.at_work.remove(&learner.run.index);
        floor.done += self.seconds(&learner.run, learner.from, pace.step);
        let said = match end {
            End::Complete => {
                floor.complete += 1;
                let score = pace
                    .score
                    .map(|(_, score)| format!(", last score {score:.1}"))
                    .unwrap_or_default();
                format!("{name} is complete{score}")
            }
            End::Unfinished => format!("{name} has stopped; the same command continues"),
            End::Failed(reason) => {
                floor.failed.push(reason.clone());
                format!("failed: {reason}")
            }
        };
        floor.display.say(&said);
    }

    /// A line for each run at work, and one for all.
    fn lines(&self, floor: &Floor) -> Vec<String> {
        let (mut lines, mut done, mut left) = (Vec::new(), floor.done, 0.0);
        for (LearnerProcess { run, from, .. }, pace) in floor.at_work.values() {
            let steps = run.experiment.steps;
            done += self.seconds(run, *from, pace.step);
            left += self.seconds(run, pace.step, steps);
            lines.push(format!("{}: step {}/{steps}, {pace}", run.name, pace.step));
        }
        for (run, state) in &self.waiting {
            left += self.seconds(run, state.step(run.experiment.steps), run.experiment.steps);
        }
        let mut all = format!(
            "{} runs complete, {} at work, {} waiting",
            floor.complete,
            lines.len(),
            self.waiting.len()
        );
        if !floor.failed.is_empty() {
            all += &format!(", {} failed", floor.failed.len());
        }
        if done > 0.0 {
            all += &format!(", {} left", HumanDuration(floor.begin.elapsed().mul_f64(left / done)));
        }
        lines.push(all);
        lines
    }

    /// Estimated seconds from one step of a run to another.
    fn seconds(&self, run: &PlannedRun, from: u64, to: u64) -> f64 {
        to.saturating_sub(from) as f64 * self.step_seconds.get(&run.index).copied().unwrap_or(1.0)
    }
}

/// Reads how far the runs at work are.
fn read(floor: &Floor) -> impl FnOnce() -> Vec<(usize, Pace)> + use<> {
    let dirs: Vec<_> =
        floor.at_work.iter().map(|(index, (learner, _))| (*index, learner.dir.clone())).collect();
    move || dirs.into_iter().map(|(index, dir)| (index, Pace::read(&dir))).collect()
}
