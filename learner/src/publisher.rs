//! The thread that publishes snapshots: takes them when they are on disk, asks for their evaluation, publishes them, and
//! answers evaluators that missed one.

use std::collections::BTreeMap;

use anyhow::Context;
use quad_dataset::Task;
use quad_policy::Description;
use quad_protocol::{Hash, Name, Schema, Snapshot, WeightsRequest, decode, encode, keys};
use quad_service::Beat;
use tokio::sync::mpsc::UnboundedSender;
use zenoh::bytes::ZBytes;

use crate::herald::Herald;
use crate::hub;
use crate::inbox::{Inbox, Messages};
use crate::metrics::Metrics;
use crate::notice::Notice;
use crate::replies::{Asker, Question};
use crate::run_dir::RunDir;

/// Messages to the thread.
#[derive(Debug)]
pub enum Event {
    /// A snapshot that is on disk and is to be evaluated.
    Kept(Kept),
    /// All gradient steps are done; no snapshot will follow.
    TrainingCompleted,
    /// The Zenoh session is open.
    Online(Herald),
    /// An evaluator asks for `weights/<step>`.
    Query(Question),
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
    herald: Option<Herald>,
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
        Self { identity, run_dir, metrics, hub, notices, herald: None, hashes, newest: None }
    }

    /// The thread's work, until it is told to stop.
    pub fn run(mut self, messages: &Messages<Event>, beat: &Beat) {
        for (&step, &weights) in &self.hashes {
            self.hub.send(hub::Event::Evaluate { step, weights });
        }
        while let Ok(event) = messages.next(beat.interval()) {
            beat.alive();
            match event {
                None => {}
                Some(Event::Kept(snapshot)) => {
                    if let Err(error) = self.publish(snapshot) {
                        self.notices.send(Notice::Failed(error)).ok();
                    }
                }
                Some(Event::TrainingCompleted) => self.hub.send(hub::Event::TrainingCompleted),
                Some(Event::Online(herald)) => self.herald = Some(herald),
                Some(Event::Query(question)) => self.answer(question),
                Some(Event::Stop) => return,
            }
        }
    }

    fn publish(&mut self, snapshot: Kept) -> anyhow::Result<()> {
        let Kept { step, kind, hash, tensors } = snapshot;
        let bytes = ZBytes::from(encode(&message(self.identity.clone(), kind, step, hash, tensors))?);
        self.hashes.insert(step, hash);
        self.newest = Some((step, bytes.clone()));
        // The jobs must exist first: evaluators ask for one as soon as the snapshot arrives.
        self.hub.send(hub::Event::Evaluate { step, weights: hash });
        // A slow subscriber loses the snapshot instead of delaying the others. It asks when it gets a job for it.
        if let Some(herald) = &self.herald {
            herald.weights(keys::weights(&self.identity.run), bytes);
        }
        self.metrics.evaluation.snapshots_published.inc();
        self.notices.send(Notice::Published { step }).ok();
        Ok(())
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
        let request = question.message().map(decode::<WeightsRequest>);
        let asker = match request {
            Some(Ok(request)) => Asker::Evaluator(request.evaluator),
            _ => Asker::Stranger,
        };
        if let Some((_, bytes)) = self.newest.as_ref().filter(|(newest, _)| *newest == step) {
            question.answer(asker, Ok((key, bytes.clone())));
            return;
        }
        let (identity, run_dir) = (self.identity.clone(), self.run_dir.clone());
        question.answer_from_disk(asker, move || {
            let bytes = saved(identity, &run_dir, step, hash);
            bytes.map(|bytes| (key, bytes)).map_err(|error| format!("{error:#}"))
        });
    }
}

fn message(identity: Identity, kind: &str, step: u64, hash: Hash, tensors: Vec<u8>) -> Snapshot {
    let Identity { run, incarnation, task } = identity;
    let schema = Schema {
        environment: task.environment,
        observation_dim: task.observation_dim as u32,
        action_dim: task.action_dim as u32,
        policy: kind.to_owned(),
    };
    Snapshot { run, incarnation, step, schema, hash, tensors }
}

/// A snapshot from the disk.
fn saved(identity: Identity, run_dir: &RunDir, step: u64, hash: Hash) -> anyhow::Result<ZBytes> {
    let tensors = run_dir.read_snapshot(step)?;
    anyhow::ensure!(Hash::of(&tensors) == hash, "the saved snapshot of step {step} was changed");
    let kind = Description::read(&tensors)?.kind();
    let bytes = encode(&message(identity, kind, step, hash, tensors)).context("cannot encode the snapshot")?;
    Ok(ZBytes::from(bytes))
}
