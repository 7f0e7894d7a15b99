//! The learner's Prometheus metrics; docs/metrics.md explains each of them.

use std::collections::HashMap;
use std::time::{SystemTime, UNIX_EPOCH};

use prometheus::process_collector::ProcessCollector;
use prometheus::{Gauge, GaugeVec, IntCounter, IntCounterVec, IntGauge, IntGaugeVec, Registry};
use quad_algorithms::Metric;
use quad_protocol::{Name, Progress};

use super::events::Saved;
use crate::train::{Registrar, TrainingMetrics};

/// All metrics of one learner. Clones are cheap; an update is an atomic store.
#[derive(Clone, Debug)]
pub(crate) struct Metrics {
    /// Metrics of the gradient steps.
    pub training: TrainingMetrics,
    /// Metrics of snapshots, jobs and scores.
    pub evaluation: EvaluationMetrics,
    /// Metrics from the evaluators' progress messages.
    pub evaluators: EvaluatorMetrics,
    /// Metrics of checkpoints and the disk.
    pub disk: DiskMetrics,
    /// Messages that the learner did not accept.
    pub rejected: IntCounterVec,
}

/// Metrics of snapshots, jobs and scores.
#[derive(Clone, Debug)]
pub(crate) struct EvaluationMetrics {
    pub snapshots_published: IntCounter,
    pub snapshot_bytes: IntGauge,
    pub jobs_handed_out: IntCounter,
    pub jobs_completed: IntCounter,
    pub jobs_expired: IntCounter,
    pub jobs_handed_back: IntCounter,
    pub jobs_failed: IntCounter,
    pub episodes_pending: IntGauge,
    pub episodes_missing: IntGauge,
    pub scores_recorded: IntCounter,
    pub scores_duplicate: IntCounter,
    pub score: Gauge,
    pub step: IntGauge,
}

/// Metrics of checkpoints and the disk.
#[derive(Clone, Debug)]
pub(crate) struct DiskMetrics {
    pub checkpoint_step: IntGauge,
    pub checkpoint_timestamp: Gauge,
    pub checkpoint_bytes: IntGauge,
    trouble: IntGaugeVec,
}

/// Metrics from the evaluators' progress messages, labeled by evaluator.
#[derive(Clone, Debug)]
pub(crate) struct EvaluatorMetrics {
    pub present: IntGauge,
    episodes: IntGaugeVec,
    environment_steps: IntGaugeVec,
    last_seen: GaugeVec,
}

impl Metrics {
    /// Makes all metrics, in a registry that labels each with the run.
    pub fn new(
        run: &Name,
        target_steps: u64,
        measured: &'static [Metric],
    ) -> prometheus::Result<(Self, Registry)> {
        let labels = HashMap::from([("run".to_owned(), run.to_string())]);
        let registry = Registry::new_custom(None, Some(labels))?;
        registry.register(Box::new(ProcessCollector::for_self()))?;
        let make = Registrar { registry: registry.clone() };
        let metrics = Self {
            training: TrainingMetrics::new(&make, target_steps, measured)?,
            evaluation: EvaluationMetrics::new(&make)?,
            evaluators: EvaluatorMetrics::new(&make)?,
            disk: DiskMetrics::new(&make)?,
            rejected: make.counters(
                "rejected_messages_total",
                "Messages that were not accepted, by reason",
                "reason",
            )?,
        };
        Ok((metrics, registry))
    }

    /// Counts a message that the learner did not accept.
    pub fn reject(&self, reason: &str) {
        self.rejected.with_label_values(&[reason]).inc();
    }
}

impl EvaluationMetrics {
    fn new(make: &Registrar) -> prometheus::Result<Self> {
        let jobs = make.counters("jobs_total", "Evaluation jobs by outcome", "outcome")?;
        let missing = "Episodes that are not handed out any more, after too many failed attempts";
        Ok(Self {
            snapshots_published: make
                .counter("snapshots_published_total", "Snapshots handed to evaluation")?,
            snapshot_bytes: make.count("snapshot_bytes", "Size of the newest snapshot")?,
            jobs_handed_out: jobs.get_metric_with_label_values(&["handed_out"])?,
            jobs_completed: jobs.get_metric_with_label_values(&["completed"])?,
            jobs_expired: jobs.get_metric_with_label_values(&["expired"])?,
            jobs_handed_back: jobs.get_metric_with_label_values(&["handed_back"])?,
            jobs_failed: jobs.get_metric_with_label_values(&["failed"])?,
            episodes_missing: make.count("episodes_missing", missing)?,
            episodes_pending: make
                .count("episodes_pending", "Episodes of evaluations that have no score yet")?,
            scores_recorded: make
                .counter("scores_recorded_total", "Episodes scored, each counted once")?,
            scores_duplicate: make
                .counter("scores_duplicate_total", "Scores delivered for episodes that had one")?,
            score: make.gauge(
                "evaluation_score",
                "Mean normalized score of the newest complete evaluation",
            )?,
            step: make
                .count("evaluation_step", "Gradient step of the newest complete evaluation")?,
        })
    }
}

impl DiskMetrics {
    fn new(make: &Registrar) -> prometheus::Result<Self> {
        let trouble = "1 while the disk does not take what is to be kept, else 0";
        let metrics = Self {
            checkpoint_step: make
                .count("checkpoint_step", "Gradient step of the newest checkpoint on disk")?,
            checkpoint_timestamp: make
                .gauge("checkpoint_timestamp_seconds", "When the newest checkpoint was written")?,
            checkpoint_bytes: make.count("checkpoint_bytes", "Size of the newest checkpoint")?,
            trouble: make.counts("disk_trouble", trouble, "what")?,
        };
        // Set from the start, so that the first trouble is a change.
        for what in Saved::ALL {
            metrics.trouble(what);
        }
        Ok(metrics)
    }

    /// The gauge that is 1 while the disk refuses this output.
    pub fn trouble(&self, what: Saved) -> IntGauge {
        self.trouble.with_label_values(&[what.label()])
    }
}

impl EvaluatorMetrics {
    fn new(make: &Registrar) -> prometheus::Result<Self> {
        let counts = |name: &str, help: &str| make.counts(name, help, "evaluator");
        let steps = "Environment steps of an evaluator since it started, as it says";
        let seen = "When an evaluator last told its progress";
        Ok(Self {
            present: make.count("evaluators", "Evaluators present")?,
            episodes: counts(
                "evaluator_episodes",
                "Episodes run by an evaluator since it started, as it says",
            )?,
            environment_steps: counts("evaluator_environment_steps", steps)?,
            last_seen: make.gauges("evaluator_last_seen_timestamp_seconds", seen, "evaluator")?,
        })
    }

    /// Records an evaluator's progress message.
    pub fn observe(&self, progress: &Progress) {
        let label = [progress.evaluator.as_str()];
        let count = |value: u64| i64::try_from(value).unwrap_or(i64::MAX);
        self.episodes.with_label_values(&label).set(count(progress.episodes));
        self.environment_steps.with_label_values(&label).set(count(progress.environment_steps));
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        self.last_seen.with_label_values(&label).set(now.as_secs_f64());
    }

    /// Drops the series of an evaluator that left long ago.
    pub fn forget(&self, evaluator: &Name) {
        let label = [evaluator.as_str()];
        // An error means that there is no such series, which is the goal.
        self.episodes.remove_label_values(&label).ok();
        self.environment_steps.remove_label_values(&label).ok();
        self.last_seen.remove_label_values(&label).ok();
    }
}
