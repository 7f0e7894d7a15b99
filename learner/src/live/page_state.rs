//! The learner's current state, as its page shows it.

use std::sync::{Arc, OnceLock};

use quad_protocol::Name;
use quad_runtime::Health;
use serde_json::{Value, json};

use super::carrier::Carrier;
use super::metrics::Metrics;
use crate::service::Connected;

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
            "evaluators": self.carrier.get().map(evaluators).unwrap_or_default(),
        })
    }
}

/// Each connected evaluator and its job.
fn evaluators(carrier: &Carrier) -> Vec<Value> {
    let service = carrier.lock();
    let evaluator = |Connected { name, fits, last_seen, job }: Connected<'_>| {
        let job = job.map(|(job, done)| {
            json!({
                "step": job.step,
                "online": job.exploration.is_some(),
                "done": done,
                "episodes": job.seeds.len(),
            })
        });
        json!({
            "name": name.as_str(),
            "fits": fits,
            "seconds_ago": last_seen.map(|seen| seen.elapsed().as_secs_f64()),
            "job": job,
        })
    };
    service.connected().map(evaluator).collect()
}
