//! The learner's current state, as its page shows it.

use std::sync::{Arc, OnceLock};

use quad_protocol::Name;
use quad_runtime::Health;
use serde_json::{Value, json};

use super::carrier::Carrier;
use super::metrics::Metrics;

/// A handle to the state. Clones share it.
#[derive(Clone)]
pub(crate) struct PageState {
    pub run: Name,
    pub steps: u64,
    pub metrics: Metrics,
    pub health: Health,
    /// Set once the threads run.
    pub carrier: Arc<OnceLock<Carrier>>,
}

impl PageState {
    pub fn to_json(&self) -> Value {
        let online = &self.metrics.online;
        let online = (online.target.get() > 0).then(|| {
            json!({
                "steps": online.rows.get(),
                "target": online.target.get(),
                "return": online.episode_return.get(),
                "wait_seconds": online.wait_seconds.get(),
            })
        });
        json!({
            "run": self.run.as_str(),
            "step": self.metrics.training.gradient_steps.get(),
            "steps": self.steps,
            "episodes_pending": self.metrics.evaluation.episodes_pending.get(),
            "online": online,
            "problems": self.health.problems(),
            "evaluators": self.carrier.get().map(Carrier::evaluators).unwrap_or_default(),
        })
    }
}
