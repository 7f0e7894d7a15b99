//! An evaluator's process: its duty, and what it plays.

use std::collections::BTreeSet;
use std::time::Duration;

use quad_evaluator::serve::delivery::Owed;
use quad_evaluator::serve::duty::{Duty, Step};
use quad_learner::service::Answer;
use quad_protocol::{Job, JobReply, JobRequest, Name, Progress};
use rand::Rng;

use crate::arithmetic::{play, precision, score};
use crate::world::{Event, Query, Reply, Sender, World, name};

const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// Time that a leaving evaluator has.
const LEAVE: Duration = Duration::from_secs(2);

pub struct EvaluatorProcess {
    pub name: Name,
    pub duty: Duty,
    /// Number of starts.
    pub epoch: u32,
    pub alive: bool,
    /// The announced learner processes, as far as it sees them.
    pub incarnations: BTreeSet<u64>,
    /// True while it is cut off from the learner.
    pub cut: bool,
    /// Evaluators of different kinds compute different bits.
    kind: u64,
    /// Duration of an environment step.
    environment_step: Duration,
    fits: bool,
    /// The query that waits for its answer, and until when.
    query: Option<(u32, Duration)>,
    queries: u32,
    /// True while a timeout is to come.
    timed: bool,
    /// Steps of results that are not acknowledged.
    pub owed: Vec<u64>,
    playing: Option<Playing>,
    leaves_at: Option<Duration>,
}

struct Playing {
    job: Job,
    done: u64,
    steps: u64,
    /// True if it makes no progress any more.
    hangs: bool,
}

impl EvaluatorProcess {
    pub fn new(world: &mut World, number: usize) -> Self {
        let now = world.instant();
        let rng = &mut world.rng;
        let kind = if world.settings.faults.other_bits { rng.random_range(0..2) } else { 0 };
        Self {
            name: name(&format!("e{number}")),
            duty: Duty::new(now),
            epoch: 1,
            alive: true,
            incarnations: BTreeSet::new(),
            cut: false,
            kind,
            environment_step: Duration::from_millis(rng.random_range(1..2000)),
            fits: number == 0 || rng.random_bool(0.95),
            query: None,
            queries: 0,
            timed: false,
            owed: Vec::new(),
            playing: None,
            leaves_at: None,
        }
    }
}

impl World {
    /// The evaluator with this number, unless it was started again since.
    fn evaluator(&mut self, number: usize, epoch: u32) -> Option<&mut EvaluatorProcess> {
        let evaluator = self.evaluators.get_mut(number);
        evaluator.filter(|evaluator| evaluator.alive && evaluator.epoch == epoch)
    }

    pub fn crash_evaluator(&mut self, number: usize) {
        let evaluator = &mut self.evaluators[number];
        if !evaluator.alive {
            return;
        }
        evaluator.alive = false;
        let gone_after = Duration::from_millis(self.rng.random_range(0..10_000));
        self.after(gone_after, Event::Token(number));
        let back_after = Duration::from_millis(self.rng.random_range(10..20_000));
        self.after(back_after, Event::StartEvaluator(number));
    }

    pub fn start_evaluator(&mut self, number: usize) {
        let evaluator = &mut self.evaluators[number];
        if evaluator.alive || self.deserted {
            return;
        }
        let epoch = evaluator.epoch + 1;
        // With its old name, as if its user had given it one.
        self.evaluators[number] = EvaluatorProcess { epoch, ..EvaluatorProcess::new(self, number) };
        self.announce_evaluator(number);
        self.tell_evaluator_of_learner(number);
    }

    pub fn leave_evaluator(&mut self, number: usize) -> Result<(), String> {
        let now = self.now;
        let evaluator = &mut self.evaluators[number];
        if evaluator.alive && evaluator.leaves_at.is_none() {
            evaluator.leaves_at = Some(now + LEAVE);
            evaluator.playing = None;
            evaluator.query = None;
            evaluator.duty.leave();
            let epoch = evaluator.epoch;
            self.after(LEAVE, Event::Turn(number, epoch));
            return self.turn(number, epoch);
        }
        Ok(())
    }

    /// An evaluator sees which learners are there.
    pub fn sees_learners(
        &mut self,
        number: usize,
        epoch: u32,
        incarnations: BTreeSet<u64>,
    ) -> Result<(), String> {
        let now = self.instant();
        let Some(evaluator) = self.evaluator(number, epoch) else { return Ok(()) };
        evaluator.incarnations = incarnations;
        evaluator.duty.follow(&evaluator.incarnations, now);
        evaluator.duty.nudge(now);
        self.turn(number, epoch)
    }

    /// Goes on with the turn of an evaluator, or begins one that is due.
    pub fn turn(&mut self, number: usize, epoch: u32) -> Result<(), String> {
        let (now, instant, random) = (self.now, self.instant(), self.rng.random());
        let Some(evaluator) = self.evaluator(number, epoch) else { return Ok(()) };
        if evaluator.leaves_at.is_some_and(|time| now >= time) {
            self.crash_evaluator(number);
            return Ok(());
        }
        if evaluator.query.is_some()
            || evaluator.playing.is_some()
            || evaluator.incarnations.is_empty()
        {
            return Ok(());
        }
        let step = match evaluator.duty.next(random) {
            Some(step) => Some(step),
            None if evaluator.duty.turn().ready_at <= instant => {
                evaluator.duty.begin_turn();
                evaluator.duty.next(random)
            }
            None => None,
        };
        match step {
            Some(step) => return self.step(number, epoch, step),
            None if evaluator.leaves_at.is_some() => self.crash_evaluator(number),
            None => {
                let pause = evaluator.duty.turn().ready_at - instant;
                self.after(pause, Event::Turn(number, epoch));
            }
        }
        Ok(())
    }

    fn step(&mut self, number: usize, epoch: u32, step: Step) -> Result<(), String> {
        self.record(|| format!("e{number}: {step:?}"));
        let evaluator = &mut self.evaluators[number];
        let name = evaluator.name.clone();
        let query = match step {
            Step::Claim { attempt } => {
                let kept = Vec::from_iter(evaluator.duty.owed_steps());
                if let Some(step) = evaluator.owed.iter().find(|step| !kept.contains(step)) {
                    return Err(format!("{name} has forgotten results of step {step}"));
                }
                let environment = if evaluator.fits { "robot" } else { "other" };
                let environments = vec![environment.to_owned()];
                Query::Job(JobRequest::Claim { evaluator: name, attempt, environments })
            }
            Step::HandBack { job, failed, .. } => {
                Query::Job(JobRequest::HandBack { evaluator: name, job, failed })
            }
            Step::Scores(report) => Query::Scores(report),
            Step::Piece(piece) => Query::Piece(piece),
            Step::Play(job) => {
                let steps = 3 * job.seeds.len() as u64;
                let query = Query::Weights(job.step);
                evaluator.playing = Some(Playing { job, done: 0, steps, hangs: false });
                query
            }
        };
        self.ask(number, epoch, query);
        Ok(())
    }

    fn ask(&mut self, number: usize, epoch: u32, query: Query) {
        let deadline = self.now + ANSWER_TIMEOUT;
        let evaluator = &mut self.evaluators[number];
        evaluator.queries += 1;
        evaluator.query = Some((evaluator.queries, deadline));
        let from = Sender { evaluator: number, epoch, query: evaluator.queries };
        if !std::mem::replace(&mut evaluator.timed, true) {
            self.after(ANSWER_TIMEOUT, Event::Timeout(number, epoch));
        }
        self.send(Event::Query(from, Box::new(query)), Some(number));
    }

    /// Ends the wait for an answer, if that time is over.
    pub fn timeout(&mut self, number: usize, epoch: u32) -> Result<(), String> {
        let now = self.now;
        let Some(evaluator) = self.evaluator(number, epoch) else { return Ok(()) };
        evaluator.timed = false;
        match evaluator.query {
            Some((query, deadline)) if now >= deadline => {
                self.answered(Sender { evaluator: number, epoch, query }, None)
            }
            Some((_, deadline)) => {
                evaluator.timed = true;
                self.after(deadline - now, Event::Timeout(number, epoch));
                Ok(())
            }
            None => Ok(()),
        }
    }

    /// The answer to a query, if it is still waited for; `None` if there was none in time.
    pub fn answered(&mut self, to: Sender, reply: Option<Reply>) -> Result<(), String> {
        let (now, spread) = (self.instant(), self.rng.random_range(0.5..1.0));
        let Sender { evaluator: number, epoch, query } = to;
        let Some(evaluator) = self.evaluator(number, epoch) else { return Ok(()) };
        if evaluator.query.is_none_or(|(waiting, _)| waiting != query) {
            return Ok(());
        }
        evaluator.query = None;
        if evaluator.playing.is_some() {
            self.begin_play(number, epoch, reply);
            return self.turn(number, epoch);
        }
        let followed = evaluator.duty.incarnation();
        let duty = &mut evaluator.duty;
        let notes = match reply {
            Some(Reply::Service(Answer::Job(JobReply::HandedBack { .. }))) => {
                duty.handed_back(now);
                Ok(Vec::new())
            }
            Some(Reply::Service(Answer::Job(reply))) if reply.incarnation() == followed => {
                duty.claimed(reply, spread, now);
                Ok(Vec::new())
            }
            Some(Reply::Service(Answer::Scores(reply))) if reply.incarnation() == followed => {
                Ok(duty.scored(reply, now))
            }
            Some(Reply::Service(Answer::Piece(reply))) if reply.incarnation() == followed => {
                duty.sent(reply, now)
            }
            reply if evaluator.leaves_at.is_some() => {
                duty.leaving_failed(reply.is_some(), false);
                Ok(Vec::new())
            }
            _ => {
                duty.unanswered(now);
                duty.follow_next(&evaluator.incarnations, now);
                Ok(Vec::new())
            }
        };
        let notes = notes.unwrap_or_else(|_| {
            evaluator.duty.unanswered(now);
            Vec::new()
        });
        for note in notes {
            self.noted(number, note)?;
        }
        self.turn(number, epoch)
    }

    fn begin_play(&mut self, number: usize, epoch: u32, reply: Option<Reply>) {
        let faults = &self.settings.faults;
        let faulty = self.now < faults.until;
        let fails = faulty && self.rng.random_bool(faults.failures);
        let hangs = faulty && self.rng.random_bool(faults.hangs);
        let evaluator = &mut self.evaluators[number];
        let Some(playing) = &mut evaluator.playing else { return };
        let wanted = (playing.job.step, playing.job.weights);
        let arrived = matches!(reply, Some(Reply::Weights(step, hash)) if (step, hash) == wanted);
        if !arrived || fails {
            evaluator.playing = None;
            return evaluator.duty.played(Err("it could not be played"));
        }
        playing.hangs = hangs;
        let pause = evaluator.environment_step;
        self.after(pause, Event::Played(number, epoch));
    }

    /// An environment step of all episodes of a job.
    pub fn played(&mut self, number: usize, epoch: u32) -> Result<(), String> {
        let Some(evaluator) = self.evaluator(number, epoch) else { return Ok(()) };
        let Some(playing) = &mut evaluator.playing else { return Ok(()) };
        if playing.hangs {
            // Someone kills it some day.
            self.after(Duration::from_secs(100), Event::CrashEvaluator(number));
            return Ok(());
        }
        playing.done += 1;
        if playing.done < playing.steps {
            let (job, done, pause) = (&playing.job, playing.done, evaluator.environment_step);
            let progress =
                Progress { steps_done: done, ..Progress::new(job, evaluator.name.clone()) };
            self.send(Event::Progress(Box::new(progress)), Some(number));
            self.after(pause, Event::Played(number, epoch));
            return Ok(());
        }
        let (kind, by) = (evaluator.kind, evaluator.name.clone());
        let Some(Playing { job, .. }) = evaluator.playing.take() else { return Ok(()) };
        let results = job.seeds.iter().map(|&seed| match job.exploration {
            None => (score(&job.weights, seed, kind), None),
            Some(rule) => {
                let episode = play(&self.settings, (job.step, job.weights), seed, rule, kind);
                (episode.score, Some(episode))
            }
        });
        let owed = Owed::new(&job, by, precision(kind), results.collect());
        let owed = owed.map_err(|error| format!("results cannot be delivered: {error}"))?;
        let evaluator = &mut self.evaluators[number];
        evaluator.owed.push(job.step);
        evaluator.duty.played(Ok(owed));
        self.turn(number, epoch)
    }
}
