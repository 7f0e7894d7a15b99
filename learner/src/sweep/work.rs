//! The work of a sweep: so many learners at a time, until every run has ended.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::pin::pin;
use std::time::{Duration, Instant};

use indicatif::HumanDuration;
use quad_run::status::{Pace, State};
use tokio::time::interval;

use super::display::Display;
use super::job::{End, Job};
use super::study::PlannedRun;
use crate::local_evaluators::LocalEvaluators;

/// How often it looks whether a learner has ended.
const GLANCE: Duration = Duration::from_millis(100);

/// What is to be done.
pub(crate) struct Sweep {
    /// Folder of the study.
    pub folder: PathBuf,
    /// The runs that are not complete.
    pub waiting: VecDeque<(PlannedRun, State)>,
    /// How many run at a time.
    pub jobs: usize,
    /// Threads of each learner.
    pub threads: usize,
    /// Where learners and evaluators meet.
    pub endpoint: String,
    /// Those that were started for it.
    pub evaluators: LocalEvaluators,
    /// Seconds of a gradient step, by the run's number; without one, all are taken to be the same.
    pub step_seconds: BTreeMap<usize, f64>,
}

/// How the runs have ended.
#[derive(Default)]
pub(crate) struct Ended {
    /// Runs that go on by the same command.
    pub unfinished: usize,
    /// What went wrong, a sentence for each run that has failed.
    pub failed: Vec<String>,
}

/// What is going on.
struct Floor {
    at_work: Vec<Job>,
    complete: usize,
    ended: Ended,
    display: Display,
    begin: Instant,
    /// Seconds of work, as foretold, that learners which have ended have done.
    done: f64,
    interrupted: bool,
}

impl Sweep {
    /// Runs all, or, at SIGINT or SIGTERM, lets those at work save what they have.
    pub async fn run(mut self) -> Ended {
        let mut shutdown = pin!(quad_runtime::shutdown_signal());
        let mut ticker = interval(GLANCE);
        let mut floor = Floor {
            at_work: Vec::new(),
            complete: 0,
            ended: Ended::default(),
            display: Display::start(),
            begin: Instant::now(),
            done: 0.0,
            interrupted: false,
        };
        while !(self.waiting.is_empty() && floor.at_work.is_empty()) {
            tokio::select! {
                _ = ticker.tick() => self.tick(&mut floor),
                () = &mut shutdown, if !floor.interrupted => {
                    floor.interrupted = true;
                    floor.display.say("stopping; the runs at work save their checkpoints");
                    floor.at_work.iter().for_each(Job::stop);
                    floor.ended.unfinished += self.waiting.len();
                    self.waiting.clear();
                }
            }
        }
        floor.display.finish();
        self.evaluators.end().await;
        floor.ended
    }

    fn tick(&mut self, floor: &mut Floor) {
        self.reap(floor);
        while floor.at_work.len() < self.jobs
            && let Some((run, state)) = self.waiting.pop_front()
        {
            let (name, dir) = (run.name.clone(), self.folder.join(&run.name));
            match Job::start(run, state, dir, &self.endpoint, self.threads) {
                Ok(job) => floor.at_work.push(job),
                Err(error) => floor.ended.failed.push(format!("{name}: {error:#}")),
            }
        }
        for line in self.evaluators.news() {
            floor.display.say(&line);
        }
        if floor.display.is_due() {
            floor.display.show(&self.lines(floor));
        }
    }

    /// Takes those away that have ended.
    fn reap(&self, floor: &mut Floor) {
        let mut still = Vec::new();
        for mut job in floor.at_work.drain(..) {
            let Some(end) = job.ended() else {
                still.push(job);
                continue;
            };
            let progress = Pace::read(&job.dir);
            floor.done += self.seconds(&job.run, job.from, progress.step);
            let name = &job.run.name;
            match end {
                End::Complete => {
                    floor.complete += 1;
                    let score = progress.score.map(|(_, score)| format!(", last score {score:.1}")).unwrap_or_default();
                    floor.display.say(&format!("{name} is complete{score}"));
                }
                End::Unfinished => {
                    floor.ended.unfinished += 1;
                    floor.display.say(&format!("{name} has stopped; the same command goes on"));
                }
                End::Failed(reason) => {
                    floor.display.say(&format!("failed: {reason}"));
                    floor.ended.failed.push(reason);
                }
            }
        }
        floor.at_work = still;
    }

    /// A line for each run at work, and one for all.
    fn lines(&self, floor: &Floor) -> Vec<String> {
        let (mut lines, mut done, mut left) = (Vec::new(), floor.done, 0.0);
        for Job { run, dir, from, .. } in &floor.at_work {
            let (progress, steps) = (Pace::read(dir), run.experiment.steps);
            done += self.seconds(run, *from, progress.step);
            left += self.seconds(run, progress.step, steps);
            lines.push(format!("{}: step {}/{steps}, {progress}", run.name, progress.step));
        }
        for (run, state) in &self.waiting {
            left += self.seconds(run, state.step(run.experiment.steps), run.experiment.steps);
        }
        let mut all =
            format!("{} runs complete, {} at work, {} waiting", floor.complete, lines.len(), self.waiting.len());
        if !floor.ended.failed.is_empty() {
            all += &format!(", {} failed", floor.ended.failed.len());
        }
        if done > 0.0 {
            all += &format!(", {} left", HumanDuration(floor.begin.elapsed().mul_f64(left / done)));
        }
        lines.push(all);
        lines
    }

    /// Seconds, as foretold, from one step of a run to another.
    fn seconds(&self, run: &PlannedRun, from: u64, to: u64) -> f64 {
        to.saturating_sub(from) as f64 * self.step_seconds.get(&run.index).copied().unwrap_or(1.0)
    }
}
