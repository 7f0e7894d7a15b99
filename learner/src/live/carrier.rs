//! Brings messages and time to the service, and does what it orders.
//!
//! Every thread may call it. It holds the service's lock for microseconds, never during input or
//! output.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use quad_protocol::{EpisodeScore, Hash, JobReply};
use tracing::{debug, warn};

use super::events::{Event, Events};
use super::metrics::Metrics;
use super::requests::Request;
use crate::service::{Answer, Count, End, Input, Order, OtherWeights, Service};
use crate::train::Inbox;

/// A handle to the service. Clones share it.
#[derive(Clone)]
pub(crate) struct Carrier {
    shared: Arc<Shared>,
    pub(super) metrics: Metrics,
    pub(super) events: Events,
    /// In an online run.
    inbox: Option<Inbox>,
}

struct Shared {
    service: Mutex<Service<Request>>,
    /// Wakes the thread `results`.
    arrived: Condvar,
    closed: AtomicBool,
}

impl Carrier {
    pub fn new(
        service: Service<Request>,
        metrics: Metrics,
        events: Events,
        inbox: Option<Inbox>,
    ) -> Self {
        let service = Mutex::new(service);
        let shared = Shared { service, arrived: Condvar::new(), closed: AtomicBool::new(false) };
        Self { shared: Arc::new(shared), metrics, events, inbox }
    }

    // A panic with the lock held ends the run.
    pub(super) fn lock(&self) -> MutexGuard<'_, Service<Request>> {
        self.shared.service.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Gives the service a message or an event. Returns the orders that are the caller's to do.
    pub fn carry(&self, input: Input<Request>) -> Vec<Order<Request>> {
        let orders = self.lock().handle(input, Instant::now());
        orders.into_iter().filter_map(|order| self.carry_out(order)).collect()
    }

    /// [`carry`](Self::carry) of a delivery, which the thread `results` takes from there.
    pub(super) fn deliver(&self, delivery: Input<Request>) {
        self.carry(delivery);
        self.shared.arrived.notify_one();
    }

    /// Waits for deliveries, for a limited time. False once there are none and none are to come.
    pub(super) fn wait_for_deliveries(&self, limit: Duration) -> bool {
        let closed = || self.shared.closed.load(Ordering::Relaxed);
        let idle = |service: &mut Service<_>| !service.has_deliveries() && !closed();
        let waited = self.shared.arrived.wait_timeout_while(self.lock(), limit, idle);
        let service = waited.unwrap_or_else(PoisonError::into_inner).0;
        service.has_deliveries() || !closed()
    }

    /// Declares that no more deliveries are waited for.
    pub(super) fn close(&self) {
        self.shared.closed.store(true, Ordering::Relaxed);
        drop(self.lock());
        self.shared.arrived.notify_one();
    }

    /// Opens the evaluation of a snapshot that is on the disk.
    ///
    /// # Errors
    /// The step is known with other weights.
    pub(super) fn open(&self, step: u64, weights: Hash) -> Result<(), OtherWeights> {
        for order in self.carry(Input::Snapshot { step, weights }) {
            if let Order::End(End::OtherWeights(error)) = order {
                return Err(error);
            }
        }
        Ok(())
    }

    /// Tells the service that time has passed, and shows its numbers. Call it several times a
    /// second.
    pub(super) fn tick(&self, training_waits: bool) -> Vec<Order<Request>> {
        let orders = self.carry(Input::Tick { training_waits });
        let gauges = self.lock().gauges();
        self.metrics.evaluators.present.set(gauges.evaluators as i64);
        self.metrics.evaluation.episodes_pending.set(gauges.pending as i64);
        self.metrics.evaluation.episodes_missing.set(gauges.missing as i64);
        orders
    }

    /// Hash of the snapshot of a step whose episodes are run.
    pub(super) fn weights(&self, step: u64) -> Option<Hash> {
        self.lock().weights(step)
    }

    fn carry_out(&self, order: Order<Request>) -> Option<Order<Request>> {
        match order {
            Order::Reply(request, Answer::Job(reply)) => {
                if let JobReply::Job(job) = &reply {
                    debug!(job = job.id, step = job.step, "handed out");
                }
                request.reply(&reply);
            }
            Order::Reply(request, Answer::Scores(reply)) => request.reply(&reply),
            Order::Reply(request, Answer::Piece(reply)) => request.reply(&reply),
            Order::Reply(request, Answer::TryAgain(why)) => request.send_error(&why),
            Order::Learn { number, episode } => {
                if let Some(inbox) = &self.inbox {
                    // Training may have ended.
                    inbox.send((number, *episode)).ok();
                }
            }
            Order::Evaluated { step, scores, earlier } => {
                self.show(step, &scores);
                if !earlier {
                    self.events.send(Event::Evaluated { step, scores });
                }
            }
            Order::Tell(line) => self.events.line(line),
            Order::Show(progress) => self.metrics.evaluators.observe(&progress),
            Order::Forget(evaluator) => self.metrics.evaluators.forget(&evaluator),
            Order::Count(count) => self.count(count),
            order @ (Order::Decode(_) | Order::Append { .. } | Order::Advise | Order::End(_)) => {
                return Some(order);
            }
        }
        None
    }

    fn count(&self, count: Count) {
        match count {
            Count::Jobs(outcome, count) => self.metrics.jobs(outcome, count),
            Count::Rejected(reason) => self.metrics.reject(reason),
            Count::Scores { new, duplicates } => {
                self.metrics.evaluation.scores_recorded.inc_by(new.into());
                self.metrics.evaluation.scores_duplicate.inc_by(duplicates.into());
            }
            Count::Difference => {
                self.metrics.online.differences.inc();
                warn!("an episode was played again with other bits; the first delivery counts");
            }
        }
    }

    /// Sets the metrics to a complete evaluation, if it is the newest.
    fn show(&self, step: u64, scores: &[EpisodeScore]) {
        let evaluation = &self.metrics.evaluation;
        if let Ok(step) = i64::try_from(step)
            && step >= evaluation.step.get()
        {
            let sum: f64 = scores.iter().map(|score| score.score).sum();
            evaluation.score.set(sum / scores.len() as f64);
            evaluation.step.set(step);
        }
    }
}
