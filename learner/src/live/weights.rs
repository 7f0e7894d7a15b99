//! Sends snapshots: the learner publishes each once, and evaluators that missed it can ask for it.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use anyhow::Context;
use quad_protocol::{Hash, Snapshot, encode, keys};
use quad_run::folder::RunDir;
use tracing::debug;
use zenoh::bytes::ZBytes;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

use super::duplicate::Incarnation;
use super::requests::NotAccepted;

/// A handle to the snapshots of a run. Clones share them.
#[derive(Clone)]
pub(super) struct Weights {
    incarnation: Incarnation,
    pub run_dir: RunDir,
    /// Set once the learner is connected.
    session: Arc<OnceLock<Session>>,
    /// The newest snapshot with its step, ready to send; older ones come from the disk.
    newest: Arc<Mutex<Option<(u64, ZBytes)>>>,
}

impl Weights {
    pub fn new(incarnation: Incarnation, run_dir: RunDir) -> Self {
        let (session, newest) = (Arc::default(), Arc::default());
        Self { incarnation, run_dir, session, newest }
    }

    /// Sets the session, so that later snapshots are published.
    pub fn connected(&self, session: &Session) {
        self.session.set(session.clone()).ok();
    }

    /// Publishes a snapshot that is on the disk and whose jobs exist.
    ///
    /// # Errors
    /// The snapshot is too large to be sent.
    pub fn publish(&self, step: u64, hash: Hash, file: Vec<u8>) -> anyhow::Result<()> {
        let bytes = self.message(step, hash, file)?;
        *self.newest.lock().unwrap_or_else(PoisonError::into_inner) = Some((step, bytes.clone()));
        if let Some(session) = self.session.get() {
            // An evaluator that does not read loses the snapshot instead of delaying others. It
            // asks for it when it gets a job.
            let put = session
                .put(keys::weights(&self.incarnation.run), bytes)
                .congestion_control(CongestionControl::Drop);
            if let Err(error) = put.wait() {
                debug!(%error, step, "the snapshot could not be published");
            }
        }
        Ok(())
    }

    /// The snapshot of a step, for an evaluator that asks. `hash` is its hash, if its episodes are
    /// run.
    pub fn snapshot(&self, step: u64, hash: Option<Hash>) -> Result<ZBytes, NotAccepted> {
        let newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner).clone();
        if let Some((_, bytes)) = newest.filter(|(newest, _)| *newest == step) {
            return Ok(bytes);
        }
        let hash = hash.ok_or(NotAccepted::NoSnapshot)?;
        self.read(step, hash).map_err(NotAccepted::Unreadable)
    }

    fn read(&self, step: u64, hash: Hash) -> anyhow::Result<ZBytes> {
        let file = self.run_dir.read_snapshot(step)?;
        anyhow::ensure!(Hash::new(&file) == hash, "the file was changed");
        self.message(step, hash, file)
    }

    fn message(&self, step: u64, hash: Hash, file: Vec<u8>) -> anyhow::Result<ZBytes> {
        let Incarnation { run, number } = self.incarnation.clone();
        let snapshot = Snapshot { run, incarnation: number, step, hash, file };
        Ok(encode(&snapshot).context("the snapshot cannot be sent to evaluators")?.into())
    }
}
