//! The thread that owns the scoreboard: it hands out jobs, records scores, and follows which evaluators are connected. A
//! single thread needs no locks, and its messages are small, so none delays the next one for long. Others send its answers and
//! write its scores.

mod announcer;
mod evaluators;
mod event;
mod followed;
mod losses;
mod rejection;
mod scores;

use std::collections::BTreeSet;
use std::iter;
use std::ops::ControlFlow;
use std::sync::mpsc::Sender;
use std::thread;
use std::time::{Duration, Instant};

use quad_protocol::{JobReply, JobRequest, Message, Name, Progress, ScoreReply, decode, encode, episode_seeds, keys};
use quad_service::{Beat, hinted, stay_in_background};
use tokio::sync::mpsc::UnboundedSender;
use tracing::{debug, info};

use crate::herald::Herald;
use crate::inbox::Messages;
use crate::metrics::Metrics;
use crate::notice::Notice;
use crate::replies::{Asker, Question};
use crate::scoreboard::{Claim, HandedBack, OtherWeights, Scoreboard};
use crate::scribe::Lines;
use crate::trouble::Saved;

use evaluators::Evaluators;
use rejection::Rejection;
use scores::Delivered;

pub use event::Event;
pub use followed::Follow;

/// How often expired leases are looked for.
const TICK: Duration = Duration::from_millis(250);
/// Most messages that are handled before the new scores in them go to the disk.
const MOST_TOGETHER: usize = 256;
/// After some messages, the next ones are left to gather for so long. To wake this thread, and those that its answers wake,
/// takes more of a processor that training needs than what they then do.
const GATHER: Duration = Duration::from_millis(20);
/// When all scores are there, those that could be scored a second time wait so long for somebody who can do it.
const LAST_AUDITS: Duration = Duration::from_secs(30);

/// Which episodes each evaluation of a run has.
#[derive(Clone, Copy, Debug)]
pub struct EvaluationPlan {
    /// Seed of the run.
    pub seed: u64,
    /// Episodes per evaluation.
    pub episodes: u32,
}

/// State of the thread.
pub struct Hub {
    run: Name,
    plan: EvaluationPlan,
    scoreboard: Scoreboard,
    scribe: Sender<Lines>,
    metrics: Metrics,
    notices: UnboundedSender<Notice>,
    evaluators: Evaluators,
    herald: Option<Herald>,
    delivered: Delivered,
    training_completed: bool,
    /// Steps of which it was told that a job failed.
    failures_told: BTreeSet<u64>,
    /// After all scores were there: since when nobody has scored any a second time.
    audited_last: Option<Instant>,
}

impl Hub {
    /// State before the first evaluation. New scores go to `scribe`.
    pub fn new(
        run: Name,
        plan: EvaluationPlan,
        scoreboard: Scoreboard,
        scribe: Sender<Lines>,
        metrics: Metrics,
        notices: UnboundedSender<Notice>,
    ) -> Self {
        Self {
            run,
            plan,
            scoreboard,
            scribe,
            evaluators: Evaluators::new(metrics.evaluators.clone(), notices.clone()),
            metrics,
            notices,
            herald: None,
            delivered: Delivered::default(),
            training_completed: false,
            failures_told: BTreeSet::new(),
            audited_last: None,
        }
    }

    /// The thread's work, until it is told to stop.
    pub fn run(mut self, messages: &Messages<Event>, beat: &Beat) {
        stay_in_background();
        let mut ticked = Instant::now();
        while let Ok(event) = messages.next(TICK) {
            beat.alive();
            let idle = event.is_none();
            if self.handle_together(event, messages).is_break() {
                return self.finish(messages);
            }
            if ticked.elapsed() >= TICK {
                ticked = Instant::now();
                self.tick(ticked);
                self.metrics.evaluation.episodes_missing.set(self.scoreboard.missing().len() as i64);
            }
            self.metrics.evaluation.episodes_pending.set(self.scoreboard.pending() as i64);
            if !idle {
                thread::sleep(GATHER);
            }
        }
    }

    /// Handles a message and those that wait behind it, before the new scores in all of them go to the disk.
    fn handle_together(&mut self, first: Option<Event>, messages: &Messages<Event>) -> ControlFlow<()> {
        let rest = iter::from_fn(|| messages.next(Duration::ZERO).ok().flatten());
        for event in first.into_iter().chain(rest).take(MOST_TOGETHER) {
            if matches!(event, Event::Stop) {
                return ControlFlow::Break(());
            }
            self.handle(event);
        }
        self.commit();
        ControlFlow::Continue(())
    }

    /// Waits until what was delivered is on the disk.
    fn finish(&mut self, messages: &Messages<Event>) {
        self.commit();
        while self.delivered.is_waiting() {
            match messages.next(TICK) {
                Ok(Some(Event::Written(written))) => self.written(&written),
                Ok(_) => {}
                Err(_) => return,
            }
            self.commit();
        }
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Evaluate { step, weights } => {
                let seeds = episode_seeds(self.plan.seed, step, self.plan.episodes);
                match self.scoreboard.add_evaluation(step, weights, &seeds) {
                    Ok(Some(scores)) => self.show(step, &scores),
                    Ok(None) => {}
                    Err(error) => drop(self.notices.send(Notice::Failed(other_weights(error)))),
                }
            }
            Event::TrainingCompleted => {
                self.training_completed = true;
                self.notices.send(Notice::Trained { pending: self.scoreboard.pending() }).ok();
                self.settle();
            }
            Event::Online { herald, follower } => {
                self.herald = Some(herald);
                self.evaluators.follow(follower);
            }
            Event::Job(question) => {
                let reply = parse(question.message()).map(|request| self.job(request));
                self.answer(question, keys::jobs(&self.run), reply);
            }
            Event::Report(question) => match parse(question.message()) {
                Ok(report) => self.report(question, report),
                Err(rejection) => self.answer::<ScoreReply>(question, keys::scores(&self.run), Err(rejection)),
            },
            Event::Progress(message) => {
                if let Err(rejection) = self.progress(&message) {
                    self.reject(&rejection);
                }
            }
            Event::Joined(evaluator) => self.evaluators.joined(evaluator, Instant::now()),
            Event::Left(evaluator) => self.left(evaluator),
            Event::Failed(error) => {
                self.notices.send(Notice::Failed(error)).ok();
            }
            Event::Written(written) => self.written(&written),
            Event::Stop => {}
        }
    }

    /// The answer, and whom it is for.
    fn job(&mut self, request: JobRequest) -> (JobReply, Name) {
        match request {
            JobRequest::Claim { evaluator, attempt, environments, precision } => {
                let now = Instant::now();
                if let Err(rejection) = self.evaluators.asked(&evaluator, now) {
                    self.reject(&rejection);
                }
                let claim = Claim {
                    evaluator: &evaluator,
                    attempt,
                    environments: &environments,
                    precision: &precision,
                    present: self.evaluators.count(),
                };
                let handed_out = self.scoreboard.handed_out();
                let reply = self.scoreboard.claim(claim, now);
                if let JobReply::Job(job) = &reply {
                    debug!(job = job.id, step = job.step, %evaluator, %precision, "handed out");
                }
                // The same job a second time is not counted.
                let new = self.scoreboard.handed_out() - handed_out;
                self.metrics.evaluation.jobs_handed_out.inc_by(new);
                (reply, evaluator)
            }
            JobRequest::HandBack { evaluator, job, lease, failed } => {
                let when = failed.is_some().then(Instant::now);
                let handed_back = self.scoreboard.hand_back(&evaluator, job, &lease, when);
                let accepted = handed_back.is_some();
                if let Some(HandedBack { step, given_up }) = handed_back {
                    match failed {
                        Some(reason) => self.failed(step, &evaluator, &reason),
                        None => self.metrics.evaluation.jobs_handed_back.inc(),
                    }
                    self.give_up(given_up);
                }
                (JobReply::HandedBack { incarnation: self.scoreboard.incarnation(), accepted }, evaluator)
            }
        }
    }

    fn progress(&mut self, message: &[u8]) -> Result<(), Rejection> {
        let progress: Progress = parse(Some(message))?;
        let now = Instant::now();
        self.scoreboard.progress(&progress, now)?;
        self.evaluators.heard(progress, now)
    }

    fn tick(&mut self, now: Instant) {
        for evaluator in self.evaluators.tick(now) {
            self.left(evaluator);
        }
        let expired = self.scoreboard.expire(now);
        if expired.jobs > 0 {
            self.notices.send(Notice::JobsExpired(expired.jobs)).ok();
        }
        self.lost(expired);
        if self.delivered.hangs(now) {
            self.metrics.disk.trouble(Saved::Scores).set(1);
        }
        self.settle();
    }

    fn settle(&mut self) {
        if !self.training_completed || self.scoreboard.pending() > 0 {
            return;
        }
        let [waiting, open] = self.scoreboard.audits();
        if waiting + open > 0 {
            let now = Instant::now();
            // Also if nobody is there who could: after a restart of this learner or its router they are about to come back.
            let since = *self.audited_last.get_or_insert_with(|| {
                let (episodes, patience) = (waiting + open, LAST_AUDITS);
                info!(episodes, ?patience, "every score is there; some wait for another evaluator to check them");
                now
            });
            if open > 0 {
                self.audited_last = Some(now);
                return;
            }
            if now - since < LAST_AUDITS {
                return;
            }
        }
        let unchecked = waiting as u64 + self.scoreboard.audits_given_up();
        if unchecked > 0 {
            self.notices.send(Notice::Unchecked(unchecked)).ok();
        }
        self.metrics.evaluation.audits_missed.inc_by(unchecked);
        self.training_completed = false; // said once
        self.notices.send(Notice::Settled).ok();
    }

    fn reject(&self, rejection: &Rejection) {
        debug!(%rejection, "a message was not accepted");
        self.metrics.reject(rejection.label());
    }

    fn answer<M: Message>(&self, question: Question, key: String, reply: Result<(M, Name), Rejection>) {
        let encoded = reply.and_then(|(message, evaluator)| Ok((encode(&message)?, evaluator)));
        match encoded {
            Ok((bytes, evaluator)) => question.answer(Asker::Evaluator(evaluator), Ok((key, bytes.into()))),
            Err(rejection) => {
                self.reject(&rejection);
                question.answer(Asker::Stranger, Err(rejection.to_string()));
            }
        }
    }
}

/// With what to do about it.
pub(crate) fn other_weights(error: OtherWeights) -> anyhow::Error {
    let hint = "another kind of processor, another number of threads or another version computes other bits: go on where the \
                run was before, or begin anew with --fresh";
    hinted(error, hint)
}

fn parse<M: Message>(message: Option<&[u8]>) -> Result<M, Rejection> {
    Ok(decode(message.ok_or(Rejection::Empty)?)?)
}
