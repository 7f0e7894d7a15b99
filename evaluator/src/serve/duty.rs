//! An evaluator's duty in one run: jobs claimed, and results kept until the learner acknowledges
//! them. It does no input or output, and asks no clock.
//!
//! [`Duty::next`] says what to do; the caller does it and reports the outcome, which says what is
//! next. A turn ends when `next` is `None`.

use std::collections::{BTreeSet, VecDeque};
use std::mem;
use std::time::{Duration, Instant};

use quad_protocol::{Job, JobReply, Piece, PieceReply, ScoreReply, ScoreReport};

use super::delivery::Owed;
use super::scheduler::Turn;

/// Shortest and longest pause that a learner without work may ask for.
const PAUSE: [Duration; 2] = [Duration::from_millis(20), Duration::from_secs(60)];
/// Most early reports that are kept, of some kilobytes each.
const MOST_EARLY: usize = 64;
/// Most characters of a reason that the evaluator sends; the learner accepts no large messages.
const MAX_REASON_LEN: usize = 1000;

#[derive(Debug)]
pub struct Duty {
    state: State,
    /// Number of the claim that has no answer yet.
    attempt: Option<u64>,
    /// Scores of snapshots that a learner, back at an earlier step, is still to train again.
    early: VecDeque<ScoreReport>,
    /// Early scores that are delivered again.
    again: Option<ScoreReport>,
    /// True if early scores were delivered again in this turn.
    delivered_again: bool,
    /// The followed learner process.
    incarnation: u64,
    turn: Turn,
    /// True until the turn ends.
    in_turn: bool,
    leaving: bool,
}

/// A claimed job is kept until the learner has acknowledged its results or its return. Meanwhile
/// the evaluator claims no other.
#[derive(Debug, Default)]
enum State {
    #[default]
    Idle,
    Claimed(Job),
    Owing(Job, Owed),
    /// With the reason, for people.
    Returning(Job, Option<String>),
}

/// A step of an evaluator's turn in a run.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    Claim {
        attempt: u64,
    },
    Play(Job),
    Scores(ScoreReport),
    Piece(Piece),
    /// To the learner process with this incarnation.
    HandBack {
        job: u64,
        incarnation: u64,
        failed: Option<String>,
    },
}

/// An event for logs and metrics.
#[derive(Debug, PartialEq)]
pub enum Note {
    Scored(ScoreReport, [u32; 2]),
    Experience {
        step: u64,
        seed: u64,
        rows: u64,
        duplicate: bool,
    },
    /// Scores of this step wait until the learner has trained to it again.
    Early {
        step: u64,
    },
    /// Results of this step are dropped, for this reason.
    Abandoned {
        step: u64,
        reason: String,
    },
}

impl Duty {
    /// The duty in a run that is due now, before it has followed a learner.
    pub fn new(now: Instant) -> Self {
        Self {
            state: State::Idle,
            attempt: None,
            early: VecDeque::new(),
            again: None,
            delivered_again: false,
            incarnation: 0,
            turn: Turn::new(now),
            in_turn: false,
            leaving: false,
        }
    }

    /// True if there are results to deliver, or a job to hand back.
    pub fn owes(&self) -> bool {
        !matches!(self.state, State::Idle) || !self.early.is_empty() || self.again.is_some()
    }

    /// True if an online episode is to be delivered, which another evaluator may not be able to play.
    pub fn owes_episode(&self) -> bool {
        matches!(self.state, State::Owing(_, Owed::Episode(_)))
    }

    /// The steps of all results that were not acknowledged.
    pub fn owed_steps(&self) -> impl Iterator<Item = u64> {
        let job = match &self.state {
            State::Owing(job, _) => Some(job.step),
            _ => None,
        };
        let early = self.again.iter().chain(self.early.iter()).map(|report| report.step);
        job.into_iter().chain(early)
    }

    pub fn turn(&self) -> &Turn {
        &self.turn
    }

    pub fn incarnation(&self) -> u64 {
        self.incarnation
    }

    /// Follows the learner process that it follows already or, if that is gone, the oldest one: of
    /// two learners of one name, the later one stops.
    pub fn follow(&mut self, incarnations: &BTreeSet<u64>, now: Instant) {
        if let Some(&first) = incarnations.first()
            && !incarnations.contains(&self.incarnation)
        {
            self.switch_to(first, now);
        }
    }

    /// Follows the next of several processes, because this one does not answer.
    pub fn follow_next(&mut self, incarnations: &BTreeSet<u64>, now: Instant) {
        let later = incarnations.range(self.incarnation.saturating_add(1)..).next();
        if let Some(&next) = later.or(incarnations.first())
            && next != self.incarnation
        {
            self.switch_to(next, now);
        }
    }

    fn switch_to(&mut self, incarnation: u64, now: Instant) {
        self.incarnation = incarnation;
        self.turn = Turn::new(now);
    }

    /// The learner is back: the run is due.
    pub fn is_back(&mut self, now: Instant) {
        self.turn = Turn::new(now);
    }

    /// There may be work: the run is due, unless its last turn failed.
    pub fn nudge(&mut self, now: Instant) {
        self.turn.nudge(now);
    }

    pub fn begin_turn(&mut self) {
        (self.in_turn, self.delivered_again) = (true, false);
    }

    fn end_turn(&mut self, ready_at: Instant) {
        (self.in_turn, self.turn) = (false, Turn::new(ready_at));
    }

    /// Ends a turn that has failed.
    fn rest(&mut self, now: Instant) {
        self.in_turn = false;
        self.turn.failed(now);
    }

    /// The next step of a turn; `None` once it has ended. A new claim gets the `random` number.
    pub fn next(&mut self, random: u64) -> Option<Step> {
        if !self.in_turn {
            return None;
        }
        let again = match &self.state {
            State::Idle if !self.delivered_again => self.early.pop_front(),
            State::Claimed(job) if !self.leaving => take_like(&mut self.early, job),
            _ => None,
        };
        if let Some(report) = again {
            return Some(Step::Scores(self.again.insert(report).clone()));
        }
        Some(match &self.state {
            State::Idle if self.leaving => {
                self.in_turn = false;
                return None;
            }
            State::Idle => Step::Claim { attempt: *self.attempt.get_or_insert(random) },
            State::Claimed(job) if self.leaving => hand_back(job, None),
            State::Claimed(job) => Step::Play(job.clone()),
            State::Owing(_, Owed::Scores(report)) => Step::Scores(report.clone()),
            State::Owing(_, Owed::Episode(parcel)) => Step::Piece(parcel.piece()),
            State::Returning(job, failed) => hand_back(job, failed.clone()),
        })
    }

    /// The learner has answered a claim. `spread`, from 0.5 to 1, spreads out evaluators that a
    /// snapshot has woken together.
    pub fn claimed(&mut self, reply: JobReply, spread: f64, now: Instant) {
        self.attempt = None;
        match reply {
            JobReply::Job(job) => self.state = State::Claimed(job),
            JobReply::Wait { milliseconds, .. } => {
                let pause = Duration::from_millis(milliseconds).clamp(PAUSE[0], PAUSE[1]);
                self.end_turn(now + pause.mul_f64(spread));
            }
            JobReply::HandedBack { .. } => self.in_turn = false,
        }
    }

    /// The claimed job is played, or cannot be.
    pub fn played(&mut self, results: Result<Owed, &str>) {
        if let State::Claimed(job) = mem::take(&mut self.state) {
            self.state = match results {
                Ok(owed) => State::Owing(job, owed),
                Err(reason) => {
                    State::Returning(job, Some(reason.chars().take(MAX_REASON_LEN).collect()))
                }
            };
        }
    }

    /// The learner has answered a delivery of scores.
    pub fn scored(&mut self, reply: ScoreReply, now: Instant) -> Vec<Note> {
        if let Some(report) = self.again.take() {
            self.delivered_again = true;
            // The next claim brings the rest of the job.
            self.state = match mem::take(&mut self.state) {
                State::Claimed(job) => State::Returning(job, None),
                other => other,
            };
            return self.delivered(report, reply);
        }
        let State::Owing(job, Owed::Scores(report)) = mem::take(&mut self.state) else {
            return Vec::new();
        };
        if let ScoreReply::Refused { reason, .. } = reply {
            return self.refused(job, format!("refused the scores: {reason}"));
        }
        self.end_turn(now);
        // The job of scores that come too early was of an earlier process.
        self.delivered(report, reply)
    }

    fn delivered(&mut self, report: ScoreReport, reply: ScoreReply) -> Vec<Note> {
        let step = report.step;
        match reply {
            ScoreReply::Recorded { new, duplicates, .. } => {
                vec![Note::Scored(report, [new, duplicates])]
            }
            ScoreReply::NotYet { .. } => {
                let oldest = self.keep_early(report);
                let dropped = oldest.map(|oldest| Note::Abandoned {
                    step: oldest.step,
                    reason: "too many scores wait for the learner".to_owned(),
                });
                [Note::Early { step }].into_iter().chain(dropped).collect()
            }
            ScoreReply::Refused { reason, .. } => {
                let reason = format!("the learner refused the scores: {reason}");
                vec![Note::Abandoned { step, reason }]
            }
        }
    }

    /// Keeps a report. If there are too many, returns the one that was kept for longest.
    fn keep_early(&mut self, report: ScoreReport) -> Option<ScoreReport> {
        self.early.push_back(report);
        if self.early.len() > MOST_EARLY { self.early.pop_front() } else { None }
    }

    /// The learner has answered a piece of an episode.
    ///
    /// # Errors
    /// It does not go on: a learner that has lost what it had gets it after a pause.
    pub fn sent(&mut self, reply: PieceReply, now: Instant) -> Result<Vec<Note>, String> {
        let State::Owing(job, Owed::Episode(mut parcel)) = mem::take(&mut self.state) else {
            return Ok(Vec::new());
        };
        match reply {
            PieceReply::Continue { offset, .. } => {
                let ahead = parcel.continue_at(offset);
                self.state = State::Owing(job, Owed::Episode(parcel));
                ahead.map(|()| Vec::new())
            }
            PieceReply::Recorded { duplicate, .. } => {
                self.end_turn(now);
                let (step, seed, rows) = (job.step, parcel.seed(), parcel.rows);
                Ok(vec![Note::Experience { step, seed, rows, duplicate }])
            }
            PieceReply::Refused { reason, .. } => {
                let seed = parcel.seed();
                Ok(self.refused(job, format!("refused the episode with seed {seed}: {reason}")))
            }
        }
    }

    /// Drops refused results: the job goes back.
    fn refused(&mut self, job: Job, refused: String) -> Vec<Note> {
        let (step, reason) = (job.step, format!("the learner {refused}"));
        self.state = State::Returning(job, Some(format!("it {refused}")));
        vec![Note::Abandoned { step, reason }]
    }

    /// The learner has taken the job back, or does not know it. After a failure the run rests.
    pub fn handed_back(&mut self, now: Instant) {
        let failed = matches!(self.state, State::Returning(_, Some(_)));
        self.state = State::Idle;
        match failed {
            true => self.rest(now),
            false => self.end_turn(now),
        }
    }

    /// A step got no usable answer: it is tried again in another turn.
    pub fn unanswered(&mut self, now: Instant) {
        self.again.take().map(|report| self.keep_early(report));
        // If another process is followed by now, the one that gave the job may be gone.
        if let State::Returning(job, _) = &self.state
            && job.incarnation != self.incarnation
        {
            self.state = State::Idle;
        }
        self.rest(now);
    }

    /// The evaluator leaves: from now on it claims and plays nothing.
    pub fn leave(&mut self) {
        (self.leaving, self.delivered_again) = (true, true);
    }

    /// A leaving evaluator's step has failed, `answered` by the learner's error or not at all: results are
    /// tried again, then the job goes back. False if it is too late for that, too.
    pub fn leaving_failed(&mut self, answered: bool, is_late: bool) -> bool {
        let again = match self.state {
            State::Owing(_, Owed::Scores(_)) => answered && !is_late,
            _ => !is_late,
        };
        if !again && let State::Owing(job, _) = mem::take(&mut self.state) {
            self.state = State::Returning(job, None);
            return true;
        }
        again
    }
}

/// Early scores of the evaluation that a job is a part of.
fn take_like(early: &mut VecDeque<ScoreReport>, job: &Job) -> Option<ScoreReport> {
    let is_like = |report: &ScoreReport| (report.step, report.weights) == (job.step, job.weights);
    let index = early.iter().position(is_like).filter(|_| job.exploration.is_none());
    early.remove(index?)
}

fn hand_back(job: &Job, failed: Option<String>) -> Step {
    Step::HandBack { job: job.id, incarnation: job.incarnation, failed }
}

#[cfg(test)]
mod tests;
