//! The learner's current state, as its page shows it.

use std::sync::{Arc, OnceLock};

use quad_protocol::Name;
use quad_runtime::Health;
use serde_json::{Value, json};

use super::coordinator::Coordinator;
use super::metrics::Metrics;

/// A handle to the state. Clones share it.
#[derive(Clone)]
pub(crate) struct Live {
    run: Name,
    steps: u64,
    metrics: Metrics,
    health: Health,
    /// Set once the threads run.
    coordinator: Arc<OnceLock<Coordinator>>,
}

impl Live {
    /// The state of a run of `steps` gradient steps that is about to begin.
    pub fn new(run: Name, steps: u64, metrics: Metrics, health: Health) -> Self {
        Self { run, steps, metrics, health, coordinator: Arc::default() }
    }

    /// Records that the run has begun.
    pub(super) fn begun(&self, coordinator: Coordinator) {
        self.coordinator.set(coordinator).ok();
    }

    /// The state as JSON.
    pub fn tell(&self) -> Value {
        json!({
            "run": self.run.as_str(),
            "step": self.metrics.training.gradient_steps.get(),
            "steps": self.steps,
            "episodes_pending": self.metrics.evaluation.episodes_pending.get(),
            "problems": self.health.problems(),
            "evaluators": self.coordinator.get().map(Coordinator::evaluators).unwrap_or_default(),
        })
    }
}
