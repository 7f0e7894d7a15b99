//! The work of a sweep: so many learners at a time, until every run has ended.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::pin::pin;
use std::time::{Duration, Instant};

use indicatif::HumanDuration;
use quad_run::status::{Pace, State};
use quad_runtime::LEAVE_WITHIN;
use tokio::task::JoinSet;
use tokio::time::{interval, timeout};

use super::display::Display;
use super::job::{End, Job, Learners, Prepared};
use super::study::PlannedRun;
use crate::local_evaluators::LocalEvaluators;

/// How often it looks whether a learner has ended.
const GLANCE: Duration = Duration::from_millis(100);
/// A learner that was told to stop ends within less; one that is frozen is killed. Then there is time for the evaluators to
/// leave before the sweep must have ended.
const LEARNERS_LEAVE: Duration = LEAVE_WITHIN.saturating_add(Duration::from_secs(2));
/// How long a sweep that was told to end waits for what a disk has to say of learners that have ended.
const LAST_WORDS: Duration = Duration::from_secs(1);

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
    /// Evaluators that were started for it.
    pub evaluators: LocalEvaluators,
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
    at_work: Vec<Job>,
    /// Tasks that read and write folders of runs, on other threads: a disk that hangs holds up neither learners nor Ctrl-C.
    disk: JoinSet<Done>,
    /// Runs whose folder is being made.
    preparing: usize,
    /// Whether the progress of the runs at work is being read.
    reading: bool,
    complete: usize,
    failed: Vec<String>,
    display: Display,
    begin: Instant,
    /// Estimated seconds of work that learners which have ended have done.
    done: f64,
    /// When the sweep was told to end.
    interrupted: Option<Instant>,
}

/// What a task on the disk has done.
enum Done {
    /// Made a run's folder.
    Prepared(anyhow::Result<Box<Prepared>>),
    /// Read and noted how a learner has ended.
    Concluded(Box<Job>, End),
    /// Read the progress of runs, by their numbers.
    Read(BTreeMap<usize, Pace>),
}

impl Sweep {
    /// Runs all, or, at SIGINT or SIGTERM, lets those at work save what they have. Learners are the calling thread's.
    pub async fn run(mut self) -> Ended {
        let mut shutdown = pin!(quad_runtime::shutdown_signal(2 * LEAVE_WITHIN));
        let mut ticker = interval(GLANCE);
        let count = self.waiting.len();
        let mut floor = Floor {
            at_work: Vec::new(),
            disk: JoinSet::new(),
            preparing: 0,
            reading: false,
            complete: 0,
            failed: Vec::new(),
            display: Display::start(),
            begin: Instant::now(),
            done: 0.0,
            interrupted: None,
        };
        loop {
            tokio::select! {
                _ = ticker.tick() => self.tick(&mut floor),
                Some(Ok(done)) = floor.disk.join_next() => self.take_in(done, &mut floor),
                () = &mut shutdown, if floor.interrupted.is_none() => {
                    floor.interrupted = Some(Instant::now());
                    floor.display.say("stopping; the runs at work save their checkpoints");
                    floor.at_work.iter_mut().for_each(Job::stop);
                    self.waiting.clear();
                }
            }
            let idle = self.waiting.is_empty() && floor.disk.is_empty();
            if floor.at_work.is_empty() && (idle || floor.interrupted.is_some()) {
                break;
            }
        }
        while let Ok(Some(Ok(done))) = timeout(LAST_WORDS, floor.disk.join_next()).await {
            self.take_in(done, &mut floor);
        }
        floor.display.finish();
        self.evaluators.end().await;
        Ended { unfinished: count - floor.complete - floor.failed.len(), failed: floor.failed }
    }

    fn tick(&mut self, floor: &mut Floor) {
        reap(floor);
        if floor.interrupted.is_some_and(|since| since.elapsed() > LEARNERS_LEAVE) {
            floor.at_work.iter_mut().for_each(Job::kill);
        }
        while floor.at_work.len() + floor.preparing < self.jobs
            && let Some((run, state)) = self.waiting.pop_front()
        {
            let (dir, learners) = (self.folder.join(&run.name), self.learners.clone());
            floor.preparing += 1;
            floor.disk.spawn_blocking(move || Done::Prepared(Prepared::new(run, state, dir, &learners).map(Box::new)));
        }
        for line in self.evaluators.news() {
            floor.display.say(&line);
        }
        if floor.display.is_due() {
            match floor.reading {
                true => floor.display.show(&self.lines(floor)),
                false => read(floor),
            }
        }
    }

    fn take_in(&self, done: Done, floor: &mut Floor) {
        match done {
            Done::Prepared(prepared) => {
                floor.preparing -= 1;
                match prepared.and_then(|run| floor.interrupted.is_none().then(|| run.start()).transpose()) {
                    Ok(job) => floor.at_work.extend(job),
                    Err(error) => floor.fail(format!("{error:#}")),
                }
            }
            Done::Concluded(job, end) => self.conclude(&job, end, floor),
            Done::Read(mut progress) => {
                floor.reading = false;
                for job in &mut floor.at_work {
                    job.progress = progress.remove(&job.run.index).unwrap_or(job.progress);
                }
                floor.display.show(&self.lines(floor));
            }
        }
    }

    fn conclude(&self, job: &Job, end: End, floor: &mut Floor) {
        let (name, progress) = (&job.run.name, &job.progress);
        floor.done += self.seconds(&job.run, job.from, progress.step);
        match end {
            End::Complete => {
                floor.complete += 1;
                let score = progress.score.map(|(_, score)| format!(", last score {score:.1}")).unwrap_or_default();
                floor.display.say(&format!("{name} is complete{score}"));
            }
            End::Unfinished => floor.display.say(&format!("{name} has stopped; the same command continues")),
            End::Failed(reason) => floor.fail(reason),
        }
    }

    /// A line for each run at work, and one for all.
    fn lines(&self, floor: &Floor) -> Vec<String> {
        let (mut lines, mut done, mut left) = (Vec::new(), floor.done, 0.0);
        for Job { run, from, progress, .. } in &floor.at_work {
            let steps = run.experiment.steps;
            done += self.seconds(run, *from, progress.step);
            left += self.seconds(run, progress.step, steps);
            lines.push(format!("{}: step {}/{steps}, {progress}", run.name, progress.step));
        }
        for (run, state) in &self.waiting {
            left += self.seconds(run, state.step(run.experiment.steps), run.experiment.steps);
        }
        let mut all =
            format!("{} runs complete, {} at work, {} waiting", floor.complete, lines.len(), self.waiting.len());
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

impl Floor {
    fn fail(&mut self, reason: String) {
        self.display.say(&format!("failed: {reason}"));
        self.failed.push(reason);
    }
}

/// Takes those away that have ended.
fn reap(floor: &mut Floor) {
    let mut at = 0;
    while let Some(job) = floor.at_work.get_mut(at) {
        let Some(status) = job.ended() else {
            at += 1;
            continue;
        };
        let mut job = Box::new(floor.at_work.remove(at));
        floor.disk.spawn_blocking(move || {
            let end = job.conclude(status);
            Done::Concluded(job, end)
        });
    }
}

/// Begins to read how far the runs at work are.
fn read(floor: &mut Floor) {
    floor.reading = true;
    let dirs: Vec<_> = floor.at_work.iter().map(|job| (job.run.index, job.dir.clone())).collect();
    floor
        .disk
        .spawn_blocking(move || Done::Read(dirs.into_iter().map(|(index, dir)| (index, Pace::read(&dir))).collect()));
}
