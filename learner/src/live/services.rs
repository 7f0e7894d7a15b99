//! Assigns each kind of message to the thread that answers it.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use quad_protocol::{JobRequest, Piece, Progress, ScoreReport, encode, keys};
use tracing::debug;
use zenoh::bytes::ZBytes;
use zenoh::sample::{Sample, SampleKind};

use super::coordinator::Coordinator;
use super::requests::{NotAccepted, Request, read};
use super::scores::Delivery;
use super::spawn::Pool;
use super::weights::Weights;

/// Threads that answer claims. Evaluators ask again if the queue is full.
const ANSWER_THREADS: usize = 4;
/// Threads that answer with weights: megabytes, which may come from a disk that hangs.
const WEIGHTS_THREADS: usize = 4;
const MOST_WAITING: usize = 1024;

#[derive(Clone)]
pub(super) struct Services {
    pub weights: Weights,
    /// The queue of the thread `scores`.
    pub deliveries: SyncSender<Delivery>,
    answers: Pool,
    weights_answers: Pool,
}

impl Services {
    /// Starts the threads that answer. Returns the queue that the thread `scores` must read.
    pub fn start(weights: Weights) -> std::io::Result<(Self, Receiver<Delivery>)> {
        let events = &weights.coordinator.events;
        let (deliveries, rx) = sync_channel(MOST_WAITING);
        let answers = Pool::start("answers", ANSWER_THREADS, MOST_WAITING, events)?;
        let weights_answers = Pool::start("weights", WEIGHTS_THREADS, MOST_WAITING, events)?;
        Ok((Self { weights, deliveries, answers, weights_answers }, rx))
    }

    pub fn coordinator(&self) -> &Coordinator {
        &self.weights.coordinator
    }

    pub fn job(&self, request: Request) {
        let coordinator = self.coordinator().clone();
        self.answer(&self.answers, request, move |request| {
            let message = request.message::<JobRequest>();
            let message = message.inspect_err(|why| coordinator.unread_claim(why))?;
            Ok(encode(&coordinator.job(&message))?.into())
        });
    }

    pub fn scores(&self, mut request: Request) {
        match request.message::<ScoreReport>() {
            Ok(report) => {
                self.coordinator().extend_lease(&report.evaluator, report.incarnation, report.job);
                self.deliver(Delivery::Scores(request, report));
            }
            Err(why) => self.answer(&self.answers, request, |_| Err(why)),
        }
    }

    pub fn experience(&self, mut request: Request) {
        match request.message::<Piece>() {
            Ok(piece) => {
                self.coordinator().extend_lease(&piece.evaluator, piece.incarnation, piece.job);
                self.deliver(Delivery::Piece(request, piece));
            }
            Err(why) => self.answer(&self.answers, request, |_| Err(why)),
        }
    }

    fn deliver(&self, delivery: Delivery) {
        self.count_busy(self.deliveries.try_send(delivery).is_ok());
    }

    pub fn weights(&self, request: Request) {
        let weights = self.weights.clone();
        self.answer(&self.weights_answers, request, move |request| {
            weights.snapshot(keys::step_of(request.key()).ok_or(NotAccepted::NoSnapshot)?)
        });
    }

    fn answer(
        &self,
        pool: &Pool,
        mut request: Request,
        work: impl FnOnce(&mut Request) -> Result<ZBytes, NotAccepted> + Send + 'static,
    ) {
        let metrics = self.coordinator().metrics.clone();
        self.count_busy(pool.give(move || match work(&mut request) {
            Ok(bytes) => request.send(bytes),
            Err(why) => request.reject(&why, &metrics),
        }));
    }

    /// Without an answer the evaluator asks again.
    fn count_busy(&self, accepted: bool) {
        if !accepted {
            self.coordinator().metrics.reject("busy");
        }
    }

    pub fn progress(&self, sample: &Sample) {
        let progress = read::<Progress>(sample.payload());
        self.count_rejected(progress.and_then(|progress| {
            self.coordinator().progress(&progress).map_err(NotAccepted::Refused)
        }));
    }

    pub fn evaluator(&self, token: &Sample) {
        let Some(evaluator) = keys::evaluator_of(token.key_expr().as_str()) else { return };
        match token.kind() {
            SampleKind::Put => self.count_rejected(self.coordinator().joined(evaluator)),
            SampleKind::Delete => self.coordinator().left(&evaluator),
        }
    }

    fn count_rejected(&self, result: Result<(), NotAccepted>) {
        if let Err(why) = result {
            debug!(%why, "a message was not accepted");
            self.coordinator().metrics.reject(why.label());
        }
    }
}
