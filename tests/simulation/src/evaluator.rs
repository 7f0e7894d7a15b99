//! An evaluator's process: its duty, and what it plays.

use std::collections::BTreeSet;
use std::time::Duration;

use quad_evaluator::serve::delivery::Owed;
use quad_evaluator::serve::duty::{Duty, Note, Step};
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
    /// The query that waits for its answer.
    query: Option<u64>,
    queries: u64,
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
            playing: None,
            leaves_at: None,
        }
    }
}

impl World {
    /// The evaluator with this number, unless it was started again since.
    fn evaluator(&mut self, number: usize, epoch: u32) -> Option<&mut EvaluatorProcess> {
        self.evaluators.get_mut(number).filter(|it| it.alive && it.epoch == epoch)
    }

    pub fn crash_evaluator(&mut self, number: usize) {
        let evaluator = &mut self.evaluators[number];
        if !evaluator.alive {
            return;
        }
        evaluator.alive = false;
        let gone_after = Duration::from_millis(self.rng.random_range(0..10_000));
        self.announce_evaluator_after(number, gone_after);
        let back_after = Duration::from_millis(self.rng.random_range(10..20_000));
        self.after(back_after, Event::StartEvaluator(number));
    }

    pub fn start_evaluator(&mut self, number: usize) {
        let evaluator = &mut self.evaluators[number];
        if evaluator.alive {
            return;
        }
        let epoch = evaluator.epoch + 1;
        // With its old name, as if its user had given it one.
        self.evaluators[number] = EvaluatorProcess { epoch, ..EvaluatorProcess::new(self, number) };
        self.announce_evaluator(number);
        self.tell_evaluator_of_learner(number);
    }

    pub fn leave_evaluator(&mut self, number: usize) {
        let now = self.now;
        let evaluator = &mut self.evaluators[number];
        if evaluator.alive && evaluator.leaves_at.is_none() {
            evaluator.leaves_at = Some(now + LEAVE);
            evaluator.playing = None;
            evaluator.query = None;
            evaluator.duty.leave();
            let epoch = evaluator.epoch;
            self.after(LEAVE, Event::Turn(number, epoch));
            self.turn(number, epoch);
        }
    }

    /// An evaluator sees which learners are there.
    pub fn sees_learners(&mut self, number: usize, epoch: u32, incarnations: BTreeSet<u64>) {
        let now = self.instant();
        let Some(evaluator) = self.evaluator(number, epoch) else { return };
        evaluator.incarnations = incarnations;
        evaluator.duty.follow(&evaluator.incarnations, now);
        evaluator.duty.nudge(now);
        self.turn(number, epoch);
    }

    /// Goes on with the turn of an evaluator, or begins one that is due.
    pub fn turn(&mut self, number: usize, epoch: u32) {
        let (now, instant, random) = (self.now, self.instant(), self.rng.random());
        let Some(evaluator) = self.evaluator(number, epoch) else { return };
        if evaluator.leaves_at.is_some_and(|at| now >= at) {
            return self.crash_evaluator(number);
        }
        if evaluator.query.is_some()
            || evaluator.playing.is_some()
            || evaluator.incarnations.is_empty()
        {
            return;
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
            Some(step) => self.step(number, epoch, step),
            None if evaluator.leaves_at.is_some() => self.crash_evaluator(number),
            None => {
                let pause = evaluator.duty.turn().ready_at - instant;
                self.after(pause, Event::Turn(number, epoch));
            }
        }
    }

    fn step(&mut self, number: usize, epoch: u32, step: Step) {
        self.record(|| format!("e{number}: {step:?}"));
        let evaluator = &mut self.evaluators[number];
        let name = evaluator.name.clone();
        let query = match step {
            Step::Claim { attempt } => {
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
    }

    fn ask(&mut self, number: usize, epoch: u32, query: Query) {
        let evaluator = &mut self.evaluators[number];
        evaluator.queries += 1;
        evaluator.query = Some(evaluator.queries);
        let from = Sender { evaluator: number, epoch, query: evaluator.queries };
        self.send(Event::Query(from, query), Some(number));
        self.after(ANSWER_TIMEOUT, Event::Timeout(from));
    }

    /// The answer to a query, if it is still waited for; `None` if there was none in time.
    pub fn answered(&mut self, to: Sender, reply: Option<Reply>) -> Result<(), String> {
        let (now, spread) = (self.instant(), self.rng.random_range(0.5..1.0));
        let Sender { evaluator: number, epoch, query } = to;
        let Some(evaluator) = self.evaluator(number, epoch) else { return Ok(()) };
        if evaluator.query != Some(query) {
            return Ok(());
        }
        evaluator.query = None;
        if evaluator.playing.is_some() {
            self.begin_play(number, epoch, reply);
            self.turn(number, epoch);
            return Ok(());
        }
        let followed = evaluator.duty.incarnation();
        let duty = &mut evaluator.duty;
        let notes = match reply {
            Some(Reply::Job(reply @ JobReply::HandedBack { .. })) => {
                drop(reply);
                duty.handed_back(now);
                Vec::new()
            }
            Some(Reply::Job(reply)) if reply.incarnation() == followed => {
                duty.claimed(reply, spread, now);
                Vec::new()
            }
            Some(Reply::Scores(reply)) if reply.incarnation() == followed => {
                duty.scored(reply, now)
            }
            Some(Reply::Piece(reply)) if reply.incarnation() == followed => {
                duty.sent(reply, now).unwrap_or_else(|_| {
                    duty.unanswered(now);
                    Vec::new()
                })
            }
            _ => {
                duty.unanswered(now);
                duty.follow_next(&evaluator.incarnations, now);
                Vec::new()
            }
        };
        for note in notes {
            self.noted(note)?;
        }
        self.turn(number, epoch);
        Ok(())
    }

    /// What the learner has acknowledged is on the disk from then on.
    fn noted(&mut self, note: Note) -> Result<(), String> {
        match note {
            Note::Scored(report, _) => {
                let seeds = report.episodes.iter().map(|episode| (report.step, episode.seed));
                self.acknowledged_scores.extend(seeds);
            }
            Note::Experience { seed, .. } => drop(self.acknowledged_episodes.insert(seed)),
            Note::Early { .. } => {}
            Note::Abandoned { step, reason } => {
                self.record(|| format!("results of step {step} are abandoned: {reason}"));
                // Training has come to all that it needs.
                let needless = self.trained && reason.contains("no online episode");
                if reason.contains("refused") && !needless {
                    return Err(format!("results of step {step} are refused: {reason}"));
                }
            }
        }
        Ok(())
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
            self.send(Event::Progress(progress), Some(number));
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
        self.evaluators[number].duty.played(Ok(owed));
        self.turn(number, epoch);
        Ok(())
    }
}
