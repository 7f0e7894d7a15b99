//! The thread that publishes snapshots: takes policies from the training thread, publishes and saves them as snapshots,
//! asks for their evaluation, and answers evaluators that missed one.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::Context;
use quad_dataset::Task;
use quad_protocol::{Hash, Name, Origin, Schema, Snapshot, WeightsRequest, decode, encode, keys};
use tokio::sync::mpsc::UnboundedSender;
use tracing::debug;
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Publisher;

use crate::agent::PolicyFile;
use crate::hub::{self, EvaluationPlan};
use crate::inbox::{Inbox, Messages};
use crate::metrics::Metrics;
use crate::notice::Notice;
use crate::replies::{Asker, Question};
use crate::run_dir::RunDir;
use crate::train::TrainedPolicy;

/// Longest wait for a message. The thread does nothing between messages, so the value does not matter.
const IDLE: Duration = Duration::from_secs(60);

/// Messages to the thread.
#[derive(Debug)]
pub enum Event {
    /// A policy from the training thread.
    Trained(TrainedPolicy),
    /// All gradient steps are done; no snapshot will follow.
    TrainingCompleted,
    /// The Zenoh session is open; publish with this.
    Online(Publisher<'static>),
    /// An evaluator asks for `weights/<step>`.
    Query(Question),
    /// End, after the messages sent before this one are handled.
    Stop,
}

/// The fields that all snapshots of a run have in common.
#[derive(Clone, Debug)]
pub struct Identity {
    /// The run.
    pub run: Name,
    /// Which start of the learner this is.
    pub incarnation: u64,
    /// Environment that the policy acts in.
    pub task: Task,
    /// Which episodes each snapshot is evaluated on.
    pub plan: EvaluationPlan,
    /// Actions sampled per state in an evaluation.
    pub candidates: u32,
}

/// State of the thread.
pub struct SnapshotPublisher {
    identity: Identity,
    run_dir: RunDir,
    metrics: Metrics,
    hub: Inbox<hub::Event>,
    notices: UnboundedSender<Notice>,
    publisher: Option<Publisher<'static>>,
    /// Hash of every snapshot that was published, by step.
    hashes: BTreeMap<u64, Hash>,
    /// The newest, ready to be sent; older ones are read from the disk.
    newest: Option<(u64, ZBytes)>,
    /// The kind of the run's policies, as the first one says.
    kind: &'static str,
}

impl SnapshotPublisher {
    /// State before the first snapshot.
    pub fn new(
        identity: Identity,
        run_dir: RunDir,
        metrics: Metrics,
        hub: Inbox<hub::Event>,
        notices: UnboundedSender<Notice>,
    ) -> Self {
        let (hashes, kind) = (BTreeMap::new(), "");
        Self { identity, run_dir, metrics, hub, notices, publisher: None, hashes, newest: None, kind }
    }

    /// The thread's work, until it is told to stop.
    pub fn run(mut self, messages: &Messages<Event>) {
        while let Ok(event) = messages.next(IDLE) {
            match event {
                None => {}
                Some(Event::Trained(policy)) => {
                    if let Err(error) = self.publish(policy) {
                        self.notices.send(Notice::Failed(error)).ok();
                    }
                }
                Some(Event::TrainingCompleted) => self.hub.send(hub::Event::TrainingCompleted),
                Some(Event::Online(publisher)) => self.publisher = Some(publisher),
                Some(Event::Query(question)) => self.answer(question),
                Some(Event::Stop) => return,
            }
        }
    }

    fn publish(&mut self, policy: TrainedPolicy) -> anyhow::Result<()> {
        let TrainedPolicy { step, policy: PolicyFile { kind, bytes }, evaluate } = policy;
        let tensors = self.origin(step).attach(&bytes)?;
        let hash = Hash::of(&tensors);
        self.metrics.evaluation.snapshot_bytes.set(tensors.len() as i64);
        if !evaluate {
            return Ok(self.run_dir.write_snapshot(step, &tensors)?);
        }
        self.kind = kind;
        let message = self.message(step, hash, tensors);
        let bytes = ZBytes::from(encode(&message)?);
        self.hashes.insert(step, hash);
        self.newest = Some((step, bytes.clone()));
        // The jobs must exist first: evaluators ask for one as soon as the snapshot arrives. Saving comes last.
        self.hub.send(hub::Event::Evaluate { step, weights: hash });
        if let Some(publisher) = &self.publisher
            && let Err(error) = publisher.put(bytes).wait()
        {
            // An evaluator that gets a job for it asks for it.
            debug!(%error, step, "the snapshot could not be published");
        }
        self.metrics.evaluation.snapshots_published.inc();
        self.run_dir.write_snapshot(step, &message.tensors)?;
        self.notices.send(Notice::Published { step }).ok();
        Ok(())
    }

    fn origin(&self, step: u64) -> Origin {
        let Identity { task, plan: EvaluationPlan { seed, episodes }, candidates, .. } = self.identity.clone();
        Origin { environment: task.environment, seed, step, episodes, candidates }
    }

    fn message(&self, step: u64, hash: Hash, tensors: Vec<u8>) -> Snapshot {
        message(self.identity.clone(), self.kind, step, hash, tensors)
    }

    /// Whatever takes time is left to the thread that sends the answer.
    fn answer(&self, question: Question) {
        let asked = question.key().and_then(|key| keys::step_of(key.as_str()));
        let Some((&step, &hash)) = asked.and_then(|step| self.hashes.get_key_value(&step)) else {
            self.metrics.reject("unknown_step");
            question.answer(Asker::Stranger, Err("there is no snapshot of that step".to_owned()));
            return;
        };
        let key = keys::weights_at(&self.identity.run, step);
        let request = question.payload().map(|payload| decode::<WeightsRequest>(&payload.to_bytes()));
        let asker = match request {
            Some(Ok(request)) => Asker::Evaluator(request.evaluator),
            _ => Asker::Stranger,
        };
        if let Some((_, bytes)) = self.newest.as_ref().filter(|(newest, _)| *newest == step) {
            question.answer(asker, Ok((key, bytes.clone())));
            return;
        }
        let (identity, kind, run_dir) = (self.identity.clone(), self.kind, self.run_dir.clone());
        question.answer_with(asker, move || {
            let bytes = saved(identity, kind, &run_dir, step, hash);
            bytes.map(|bytes| (key, bytes)).map_err(|error| format!("{error:#}"))
        });
    }
}

fn message(identity: Identity, kind: &str, step: u64, hash: Hash, tensors: Vec<u8>) -> Snapshot {
    let Identity { run, incarnation, task, .. } = identity;
    let schema = Schema {
        environment: task.environment,
        observation_dim: task.observation_dim as u32,
        action_dim: task.action_dim as u32,
        policy: kind.to_owned(),
    };
    Snapshot { run, incarnation, step, schema, hash, tensors }
}

/// A snapshot from the disk.
fn saved(identity: Identity, kind: &str, run_dir: &RunDir, step: u64, hash: Hash) -> anyhow::Result<ZBytes> {
    let tensors = run_dir.read_snapshot(step)?;
    anyhow::ensure!(Hash::of(&tensors) == hash, "the saved snapshot of step {step} was changed");
    let bytes = encode(&message(identity, kind, step, hash, tensors)).context("cannot encode the snapshot")?;
    Ok(ZBytes::from(bytes))
}
