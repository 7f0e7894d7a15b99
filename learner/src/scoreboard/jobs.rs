//! The jobs that are open, by their number and by who has them.

use std::collections::{BTreeMap, HashMap};
use std::time::Instant;

use quad_protocol::Name;

use super::job::OpenJob;

/// An evaluator has one job at a time.
#[derive(Debug, Default)]
pub(super) struct OpenJobs {
    jobs: BTreeMap<u64, OpenJob>,
    of: HashMap<Name, u64>,
}

impl OpenJobs {
    /// One that was handed out to an evaluator that had none.
    pub fn insert(&mut self, id: u64, job: OpenJob) {
        self.of.insert(job.evaluator.clone(), id);
        self.jobs.insert(id, job);
    }

    pub fn get(&self, id: u64) -> Option<&OpenJob> {
        self.jobs.get(&id)
    }

    pub fn get_mut(&mut self, id: u64) -> Option<&mut OpenJob> {
        self.jobs.get_mut(&id)
    }

    /// The one that an evaluator has.
    pub fn of(&self, evaluator: &Name) -> Option<(u64, &OpenJob)> {
        let id = *self.of.get(evaluator)?;
        Some((id, self.jobs.get(&id)?))
    }

    pub fn remove(&mut self, id: u64) -> Option<OpenJob> {
        let job = self.jobs.remove(&id)?;
        self.of.remove(&job.evaluator);
        Some(job)
    }

    /// Those whose evaluators have lost them.
    pub fn lost(&self, now: Instant) -> Vec<u64> {
        self.jobs.iter().filter(|(_, job)| job.is_lost(now)).map(|(&id, _)| id).collect()
    }
}
