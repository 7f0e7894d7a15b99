//! The thread that publishes snapshots: takes them when they are on disk, asks for their evaluation, publishes them, and
//! answers evaluators that missed one.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::Context;
use quad_dataset::Task;
use quad_policy::Description;
use quad_protocol::{Hash, Name, Schema, Snapshot, encode, keys};
use tokio::sync::mpsc::UnboundedSender;
use tracing::debug;
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Publisher;
use zenoh::query::Query;

use crate::hub;
use crate::inbox::{Inbox, Messages};
use crate::metrics::Metrics;
use crate::notice::Notice;
use crate::run_dir::RunDir;

/// Longest wait for a message. The thread does nothing between messages, so the value does not matter.
const IDLE: Duration = Duration::from_secs(60);

/// Messages to the thread.
#[derive(Debug)]
pub enum Event {
    /// A snapshot that is on disk and is to be evaluated.
    Kept(Kept),
    /// All gradient steps are done; no snapshot will follow.
    TrainingCompleted,
    /// The Zenoh session is open; publish with this.
    Online(Publisher<'static>),
    /// An evaluator asks for `weights/<step>`.
    Query(Query),
    /// End, after the messages sent before this one are handled.
    Stop,
}

/// A snapshot that is on disk.
#[derive(Debug)]
pub struct Kept {
    /// After which gradient step.
    pub step: u64,
    /// The kind of its policy.
    pub kind: &'static str,
    /// Hash of the file.
    pub hash: Hash,
    /// The file.
    pub tensors: Vec<u8>,
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
}

/// State of the thread.
pub struct SnapshotPublisher {
    identity: Identity,
    run_dir: RunDir,
    metrics: Metrics,
    hub: Inbox<hub::Event>,
    notices: UnboundedSender<Notice>,
    publisher: Option<Publisher<'static>>,
    /// Hash of every snapshot that may be asked for, by step.
    hashes: BTreeMap<u64, Hash>,
    /// The newest, ready to be sent; older ones are read from the disk.
    newest: Option<(u64, ZBytes)>,
}

impl SnapshotPublisher {
    /// State before the first snapshot of this life; `hashes` are those of an earlier one, which are on disk.
    pub fn new(
        identity: Identity,
        run_dir: RunDir,
        metrics: Metrics,
        hub: Inbox<hub::Event>,
        notices: UnboundedSender<Notice>,
        hashes: BTreeMap<u64, Hash>,
    ) -> Self {
        Self { identity, run_dir, metrics, hub, notices, publisher: None, hashes, newest: None }
    }

    /// The thread's work, until it is told to stop.
    pub fn run(mut self, messages: &Messages<Event>) {
        for (&step, &weights) in &self.hashes {
            self.hub.send(hub::Event::Evaluate { step, weights });
        }
        while let Ok(event) = messages.next(IDLE) {
            match event {
                None => {}
                Some(Event::Kept(snapshot)) => {
                    if let Err(error) = self.publish(snapshot) {
                        self.notices.send(Notice::Failed(error)).ok();
                    }
                }
                Some(Event::TrainingCompleted) => self.hub.send(hub::Event::TrainingCompleted),
                Some(Event::Online(publisher)) => self.publisher = Some(publisher),
                Some(Event::Query(query)) => self.answer(&query),
                Some(Event::Stop) => return,
            }
        }
    }

    fn publish(&mut self, snapshot: Kept) -> anyhow::Result<()> {
        let Kept { step, kind, hash, tensors } = snapshot;
        let bytes = ZBytes::from(encode(&self.message(step, kind, hash, tensors))?);
        self.hashes.insert(step, hash);
        self.newest = Some((step, bytes.clone()));
        // The jobs must exist first: evaluators ask for one as soon as the snapshot arrives.
        self.hub.send(hub::Event::Evaluate { step, weights: hash });
        if let Some(publisher) = &self.publisher
            && let Err(error) = publisher.put(bytes).wait()
        {
            // An evaluator that gets a job for it asks for it.
            debug!(%error, step, "the snapshot could not be published");
        }
        self.metrics.evaluation.snapshots_published.inc();
        self.notices.send(Notice::Published { step }).ok();
        Ok(())
    }

    fn message(&self, step: u64, kind: &str, hash: Hash, tensors: Vec<u8>) -> Snapshot {
        let Identity { run, incarnation, task } = self.identity.clone();
        let schema = Schema {
            environment: task.environment,
            observation_dim: task.observation_dim as u32,
            action_dim: task.action_dim as u32,
            policy: kind.to_owned(),
        };
        Snapshot { run, incarnation, step, schema, hash, tensors }
    }

    fn answer(&self, query: &Query) {
        let asked = keys::step_of(query.key_expr().as_str());
        let Some((&step, &hash)) = asked.and_then(|step| self.hashes.get_key_value(&step)) else {
            self.metrics.reject("unknown_step");
            query.reply_err("there is no snapshot of that step").wait().ok();
            return;
        };
        let sent = match self.bytes(step, hash) {
            Ok(bytes) => query.reply(keys::weights_at(&self.identity.run, step), bytes).wait(),
            Err(error) => query.reply_err(format!("{error:#}")).wait(),
        };
        if let Err(error) = sent {
            debug!(%error, step, "the answer to a question for weights could not be sent");
        }
    }

    fn bytes(&self, step: u64, hash: Hash) -> anyhow::Result<ZBytes> {
        if let Some((newest, bytes)) = &self.newest
            && *newest == step
        {
            return Ok(bytes.clone());
        }
        let tensors = self.run_dir.read_snapshot(step)?;
        anyhow::ensure!(Hash::of(&tensors) == hash, "the saved snapshot of step {step} was changed");
        let kind = Description::read(&tensors)?.kind();
        let bytes = encode(&self.message(step, kind, hash, tensors)).context("cannot encode the snapshot")?;
        Ok(ZBytes::from(bytes))
    }
}
