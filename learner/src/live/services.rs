//! Which thread answers each kind of message.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use quad_protocol::{JobRequest, Progress, ScoreReport, keys};
use tracing::debug;
use zenoh::sample::{Sample, SampleKind};

use super::coordinator::Coordinator;
use super::events::Events;
use super::metrics::Metrics;
use super::requests::{NotAccepted, Request, read};
use super::scores::Delivery;
use super::spawn::Pool;
use super::weights::Weights;

/// Threads that answer claims. Evaluators ask again if the queue is full.
const ANSWER_THREADS: usize = 4;
/// Threads that answer with weights: megabytes, which may come from a disk that hangs.
const WEIGHTS_THREADS: usize = 4;
const MOST_WAITING: usize = 1024;

/// The threads that answer queries.
#[derive(Clone)]
pub(super) struct Services {
    pub coordinator: Coordinator,
    pub weights: Weights,
    /// The queue of the thread `scores`.
    pub deliveries: SyncSender<Delivery>,
    pub answers: Pool,
    pub weights_answers: Pool,
    pub metrics: Metrics,
    pub events: Events,
}

impl Services {
    /// Starts the threads that answer. Returns the queue that the thread `scores` must read.
    pub fn start(
        coordinator: Coordinator,
        weights: Weights,
        metrics: Metrics,
        events: Events,
    ) -> std::io::Result<(Self, Receiver<Delivery>)> {
        let (deliveries, waiting) = sync_channel(MOST_WAITING);
        let answers = Pool::start("answers", ANSWER_THREADS, MOST_WAITING, &events)?;
        let weights_answers = Pool::start("weights", WEIGHTS_THREADS, MOST_WAITING, &events)?;
        Ok((
            Self { coordinator, weights, deliveries, answers, weights_answers, metrics, events },
            waiting,
        ))
    }

    pub fn job(&self, mut request: Request) {
        let (coordinator, metrics) = (self.coordinator.clone(), self.metrics.clone());
        let answer = move || match request.message::<JobRequest>() {
            Ok(message) => request.reply(&coordinator.job(&message)),
            Err(why) => request.reject(&why, &metrics),
        };
        self.count_busy(self.answers.give(answer));
    }

    pub fn report(&self, mut request: Request) {
        let accepted = match request.message::<ScoreReport>() {
            Ok(report) => {
                // Extends the lease of the job until its scores are on the disk.
                self.coordinator.keep(&report);
                self.deliveries.try_send(Some((request, report))).is_ok()
            }
            Err(why) => {
                let metrics = self.metrics.clone();
                self.answers.give(move || request.reject(&why, &metrics))
            }
        };
        self.count_busy(accepted);
    }

    pub fn weights(&self, request: Request) {
        let (weights, metrics) = (self.weights.clone(), self.metrics.clone());
        let answer = move || match keys::step_of(request.key())
            .ok_or(NotAccepted::NoSnapshot)
            .and_then(|of| weights.of(of))
        {
            Ok(bytes) => request.send(bytes),
            Err(why) => request.reject(&why, &metrics),
        };
        self.count_busy(self.weights_answers.give(answer));
    }

    /// Without an answer the evaluator asks again.
    fn count_busy(&self, accepted: bool) {
        if !accepted {
            self.metrics.reject("busy");
        }
    }

    pub fn progress(&self, sample: &Sample) {
        let progress = read::<Progress>(sample.payload());
        self.take_in(progress.and_then(|progress| self.coordinator.progress(progress)));
    }

    pub fn evaluator(&self, token: &Sample) {
        let Some(evaluator) = keys::evaluator_of(token.key_expr().as_str()) else { return };
        match token.kind() {
            SampleKind::Put => self.take_in(self.coordinator.joined(evaluator)),
            SampleKind::Delete => self.coordinator.left(&evaluator),
        }
    }

    fn take_in(&self, result: Result<(), NotAccepted>) {
        if let Err(why) = result {
            debug!(%why, "a message was not accepted");
            self.metrics.reject(why.label());
        }
    }
}
