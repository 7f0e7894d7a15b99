//! An evaluator's Prometheus metrics; docs/metrics.md explains each of them.

use prometheus::core::Collector;
use prometheus::process_collector::ProcessCollector;
use prometheus::{
    Counter, Histogram, HistogramOpts, IntCounter, IntCounterVec, IntGauge, Opts, Registry,
};

/// How a job ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JobOutcome {
    /// The learner acknowledged its scores.
    Scored,
    /// The evaluator gave it up: it is leaving and hands the job back, or the learner refused the
    /// scores or never came back.
    Abandoned,
    /// The evaluator could not use its weights or its environment, the policy could not act, or a
    /// return does not count.
    Failed,
}

impl JobOutcome {
    const ALL: [JobOutcome; 3] = [JobOutcome::Scored, JobOutcome::Abandoned, JobOutcome::Failed];

    fn label(self) -> &'static str {
        match self {
            JobOutcome::Scored => "scored",
            JobOutcome::Abandoned => "abandoned",
            JobOutcome::Failed => "failed",
        }
    }
}

/// The metrics of one evaluator process, in a registry of their own; their help says what each
/// counts.
#[derive(Clone)]
pub struct Metrics {
    /// The registry that `/metrics` serves.
    pub registry: Registry,
    pub episodes: IntCounter,
    pub environment_steps: IntCounter,
    pub snapshots_received: IntCounter,
    pub episode_score: Histogram,
    pub job_duration: Histogram,
    pub select_seconds: Counter,
    pub physics_seconds: Counter,
    pub runs: IntGauge,
    jobs: IntCounterVec,
    rejected_messages: IntCounterVec,
}

impl Metrics {
    /// Registers all metrics, and those of the process (`process_…`).
    pub fn new() -> prometheus::Result<Metrics> {
        let registry = Registry::new();
        registry.register(Box::new(ProcessCollector::for_self()))?;
        let counter = |name: &str, help: &str| register(&registry, IntCounter::new(name, help)?);
        let seconds = |name: &str, help: &str| register(&registry, Counter::new(name, help)?);
        let histogram = |name: &str, help: &str, buckets: &[f64]| {
            let options = HistogramOpts::new(name, help).buckets(buckets.to_vec());
            register(&registry, Histogram::with_opts(options)?)
        };
        let labeled = |name: &str, help: &str, label: &str| {
            register(&registry, IntCounterVec::new(Opts::new(name, help), &[label])?)
        };
        let metrics = Metrics {
            episodes: counter("quad_evaluator_episodes_total", "Episodes finished")?,
            environment_steps: counter(
                "quad_evaluator_environment_steps_total",
                "Environment steps taken",
            )?,
            snapshots_received: counter(
                "quad_evaluator_snapshots_received_total",
                "Weight snapshots received whole and verified",
            )?,
            // A score of 100 is an expert; the fine buckets are for the start of training.
            episode_score: histogram(
                "quad_evaluator_episode_score",
                "Normalized score of each scored episode",
                &[
                    1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0,
                    110.0,
                ],
            )?,
            job_duration: histogram(
                "quad_evaluator_job_duration_seconds",
                "Time from a job's hand-out to the end of its last episode",
                &[0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 25.0, 50.0, 100.0, 250.0],
            )?,
            select_seconds: seconds(
                "quad_evaluator_select_seconds_total",
                "Time spent choosing actions",
            )?,
            physics_seconds: seconds(
                "quad_evaluator_physics_seconds_total",
                "Time spent in the physics",
            )?,
            runs: register(
                &registry,
                IntGauge::new("quad_evaluator_runs", "Runs that are being served")?,
            )?,
            jobs: labeled("quad_evaluator_jobs_total", "Jobs by how they ended", "outcome")?,
            rejected_messages: labeled(
                "quad_evaluator_rejected_messages_total",
                "Messages from the wire that were not used, by reason",
                "reason",
            )?,
            registry: registry.clone(),
        };
        for outcome in JobOutcome::ALL {
            metrics.jobs.with_label_values(&[outcome.label()]);
        }
        Ok(metrics)
    }

    /// Counts a job that has ended.
    pub fn job(&self, outcome: JobOutcome) {
        self.jobs.with_label_values(&[outcome.label()]).inc();
    }

    /// Counts a message that the evaluator did not use. The reasons are a fixed list, because the
    /// registry keeps every label.
    pub fn rejected(&self, reason: &'static str) {
        self.rejected_messages.with_label_values(&[reason]).inc();
    }
}

/// Adds a metric to the registry.
fn register<M: Collector + Clone + 'static>(
    registry: &Registry,
    metric: M,
) -> prometheus::Result<M> {
    registry.register(Box::new(metric.clone()))?;
    Ok(metric)
}
