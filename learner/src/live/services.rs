//! Assigns each kind of message to the thread that answers it.

use quad_protocol::{CodecError, JobRequest, Message, keys};
use tracing::debug;
use zenoh::sample::{Sample, SampleKind};

use super::carrier::Carrier;
use super::requests::{NotAccepted, Request, read};
use super::spawn::Pool;
use super::weights::Weights;
use crate::service::Input;

/// Threads that answer claims. Evaluators ask again if the queue is full.
const ANSWER_THREADS: usize = 4;
/// Threads that answer with weights: megabytes, which may come from a disk that hangs.
const WEIGHTS_THREADS: usize = 4;
const MOST_WAITING: usize = 1024;

#[derive(Clone)]
pub(super) struct Services {
    pub carrier: Carrier,
    pub weights: Weights,
    answers: Pool,
    weights_answers: Pool,
}

impl Services {
    /// Starts the threads that answer.
    pub fn start(carrier: Carrier, weights: Weights) -> std::io::Result<Self> {
        let events = &carrier.events;
        let answers = Pool::start("answers", ANSWER_THREADS, MOST_WAITING, events)?;
        let weights_answers = Pool::start("weights", WEIGHTS_THREADS, MOST_WAITING, events)?;
        Ok(Self { carrier, weights, answers, weights_answers })
    }

    pub fn job(&self, mut request: Request) {
        let carrier = self.carrier.clone();
        self.give(&self.answers, move || match request.message::<JobRequest>() {
            Ok(message) => drop(carrier.carry(Input::Job(request, message))),
            Err(why) => {
                request.reject(&why, &carrier.metrics);
                if let NotAccepted::Codec(error @ CodecError::Version { .. }) = why {
                    carrier.carry(Input::OtherVersion(error));
                }
            }
        });
    }

    pub fn scores(&self, request: Request) {
        self.deliver(request, Input::Scores);
    }

    pub fn experience(&self, request: Request) {
        self.deliver(request, Input::Piece);
    }

    fn deliver<M: Message>(&self, mut request: Request, input: fn(Request, M) -> Input<Request>) {
        match request.message() {
            Ok(message) => self.carrier.deliver(input(request, message)),
            Err(why) => {
                let metrics = self.carrier.metrics.clone();
                self.give(&self.answers, move || request.reject(&why, &metrics));
            }
        }
    }

    pub fn weights(&self, request: Request) {
        let (carrier, weights) = (self.carrier.clone(), self.weights.clone());
        self.give(&self.weights_answers, move || {
            let step = keys::step_of(request.key()).ok_or(NotAccepted::NoSnapshot);
            match step.and_then(|step| weights.snapshot(step, carrier.weights(step))) {
                Ok(bytes) => request.send(bytes),
                Err(why) => request.reject(&why, &carrier.metrics),
            }
        });
    }

    /// Without an answer the evaluator asks again.
    fn give(&self, pool: &Pool, work: impl FnOnce() + Send + 'static) {
        if !pool.give(work) {
            self.carrier.metrics.reject("busy");
        }
    }

    pub fn progress(&self, sample: &Sample) {
        match read(sample.payload()) {
            Ok(progress) => drop(self.carrier.carry(Input::Progress(progress))),
            Err(why) => {
                debug!(%why, "a message was not accepted");
                self.carrier.metrics.reject(why.label());
            }
        }
    }

    pub fn evaluator(&self, token: &Sample) {
        let Some(evaluator) = keys::evaluator_of(token.key_expr().as_str()) else { return };
        self.carrier.carry(match token.kind() {
            SampleKind::Put => Input::Joined(evaluator),
            SampleKind::Delete => Input::Left(evaluator),
        });
    }
}
