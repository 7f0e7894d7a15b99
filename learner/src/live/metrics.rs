//! The learner's Prometheus metrics; docs/metrics.md explains each of them.

use std::collections::HashMap;
use std::time::{SystemTime, UNIX_EPOCH};

use prometheus::process_collector::ProcessCollector;
use prometheus::{IntGauge, Registry};
use quad_algorithms::Metric;
use quad_protocol::{Name, Progress};

use super::disk::Writer;
use crate::train::{OnlineMetrics, TrainingMetrics, metrics};

/// All metrics of one learner. Clones are cheap; an update is an atomic store.
#[derive(Clone, Debug)]
pub(crate) struct Metrics {
    pub training: TrainingMetrics,
    pub online: OnlineMetrics,
    pub evaluation: EvaluationMetrics,
    pub evaluators: EvaluatorMetrics,
    pub disk: DiskMetrics,
}

metrics! {
    EvaluationMetrics {
        snapshots_published: IntCounter("snapshots_published_total", "Snapshots handed to evaluation"),
        snapshot_bytes: IntGauge("snapshot_bytes", "Size of the newest snapshot"),
        jobs: IntCounterVec("jobs_total", "Evaluation jobs by outcome", "outcome"),
        episodes_missing: IntGauge("episodes_missing",
            "Episodes that are not handed out any more, after too many failed attempts"),
        episodes_pending: IntGauge("episodes_pending", "Episodes of evaluations that have no score yet"),
        scores_recorded: IntCounter("scores_recorded_total", "Episodes scored, each counted once"),
        scores_duplicate: IntCounter("scores_duplicate_total", "Scores delivered for episodes that had one"),
        score: Gauge("evaluation_score", "Mean normalized score of the newest complete evaluation"),
        step: IntGauge("evaluation_step", "Gradient step of the newest complete evaluation"),
        rejected: IntCounterVec("rejected_messages_total", "Messages that were not accepted, by reason", "reason"),
    }
}

metrics! {
    DiskMetrics {
        checkpoint_step: IntGauge("checkpoint_step", "Gradient step of the newest checkpoint on disk"),
        checkpoint_timestamp: Gauge("checkpoint_timestamp_seconds", "When the newest checkpoint was written"),
        checkpoint_bytes: IntGauge("checkpoint_bytes", "Size of the newest checkpoint"),
        trouble: IntGaugeVec("disk_trouble", "1 while the disk does not take what is to be kept, else 0", "what"),
    }
}

metrics! {
    /// Metrics from the evaluators' progress messages.
    EvaluatorMetrics {
        present: IntGauge("evaluators", "Evaluators present"),
        episodes: IntGaugeVec("evaluator_episodes",
            "Episodes run by an evaluator since it started, as it says", "evaluator"),
        environment_steps: IntGaugeVec("evaluator_environment_steps",
            "Environment steps of an evaluator since it started, as it says", "evaluator"),
        last_seen: GaugeVec("evaluator_last_seen_timestamp_seconds",
            "When an evaluator last reported its progress", "evaluator"),
    }
}

impl Metrics {
    /// Makes all metrics, in a registry that labels each with the run.
    pub fn new(
        run: &Name,
        target_steps: u64,
        algorithm: &'static [Metric],
    ) -> prometheus::Result<(Self, Registry)> {
        let labels = HashMap::from([("run".to_owned(), run.to_string())]);
        let registry = Registry::new_custom(None, Some(labels))?;
        registry.register(Box::new(ProcessCollector::for_self()))?;
        let metrics = Self {
            training: TrainingMetrics::new(&registry, target_steps, algorithm)?,
            online: OnlineMetrics::new(&registry)?,
            evaluation: EvaluationMetrics::new(&registry)?,
            evaluators: EvaluatorMetrics::new(&registry)?,
            disk: DiskMetrics::new(&registry)?,
        };
        // Set from the start, so that the first increment is a change.
        for writer in Writer::ALL {
            metrics.disk_trouble(writer);
        }
        for outcome in ["handed_out", "completed", "expired", "handed_back", "failed"] {
            metrics.jobs(outcome, 0);
        }
        Ok((metrics, registry))
    }

    /// Counts a message that the learner did not accept.
    pub fn reject(&self, reason: &str) {
        self.evaluation.rejected.with_label_values(&[reason]).inc();
    }

    /// Counts jobs with this outcome.
    pub fn jobs(&self, outcome: &str, count: usize) {
        self.evaluation.jobs.with_label_values(&[outcome]).inc_by(count as u64);
    }

    /// The gauge that is 1 while the disk refuses the output of this thread.
    pub fn disk_trouble(&self, writer: Writer) -> IntGauge {
        self.disk.trouble.with_label_values(&[writer.label])
    }
}

impl EvaluatorMetrics {
    pub fn observe(&self, progress: &Progress) {
        let label = [progress.evaluator.as_str()];
        let count = |value: u64| i64::try_from(value).unwrap_or(i64::MAX);
        self.episodes.with_label_values(&label).set(count(progress.episodes));
        let steps = count(progress.environment_steps);
        self.environment_steps.with_label_values(&label).set(steps);
        self.last_seen.with_label_values(&label).set(unix_time());
    }

    /// Drops the series of an evaluator that has left.
    pub fn forget(&self, evaluator: &Name) {
        let label = [evaluator.as_str()];
        // An error means that there is no such series, which is the goal.
        self.episodes.remove_label_values(&label).ok();
        self.environment_steps.remove_label_values(&label).ok();
        self.last_seen.remove_label_values(&label).ok();
    }
}

/// Seconds since 1970.
pub(super) fn unix_time() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64()
}
