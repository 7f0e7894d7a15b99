//! An evaluator's Prometheus metrics, explained in docs/metrics.md.

use prometheus::core::Collector;
use prometheus::process_collector::ProcessCollector;
use prometheus::{
    Counter, Histogram, HistogramOpts, IntCounter, IntCounterVec, IntGauge, Opts, Registry,
};

/// Ends of a job.
const OUTCOMES: [&str; 4] = ["scored", "played", "abandoned", "failed"];

/// The metrics of one evaluator process.
#[derive(Clone)]
pub struct Metrics {
    pub registry: Registry,
    pub episodes: IntCounter,
    pub environment_steps: IntCounter,
    pub snapshots_received: IntCounter,
    pub episode_score: Histogram,
    pub experience_rows: IntCounter,
    pub job_duration: Histogram,
    pub select_seconds: Counter,
    pub physics_seconds: Counter,
    pub runs: IntGauge,
    jobs: IntCounterVec,
    rejected_messages: IntCounterVec,
}

/// Finer where training starts; a score of 100 is an expert.
const SCORE_BUCKETS: &[f64] =
    &[1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0, 110.0];
const SECONDS_BUCKETS: &[f64] = &[0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 25.0, 50.0, 100.0, 250.0];

impl Metrics {
    /// Registers all metrics, and those of the process (`process_…`).
    pub fn new() -> prometheus::Result<Metrics> {
        let registry = Registry::new();
        registry.register(Box::new(ProcessCollector::for_self()))?;
        let opts = |name: &str, help: &str| Opts::new(format!("quad_evaluator_{name}"), help);
        let count = |name, help| register(&registry, IntCounter::with_opts(opts(name, help))?);
        let seconds = |name, help| register(&registry, Counter::with_opts(opts(name, help))?);
        let histogram = |name, help, buckets: &[f64]| {
            let opts = HistogramOpts::from(opts(name, help)).buckets(buckets.to_vec());
            register(&registry, Histogram::with_opts(opts)?)
        };
        let labeled = |name, help, label: &str| {
            register(&registry, IntCounterVec::new(opts(name, help), &[label])?)
        };
        let received = "Weight snapshots received whole and verified";
        let score = "Normalized score of each scored episode";
        let experience = "Online environment steps that a learner has acknowledged";
        let duration = "Time from the beginning of a job's episodes to the end of the last";
        let rejected = "Messages from the wire that were not used, by reason";
        let runs = IntGauge::with_opts(opts("runs", "Runs that are being served"))?;
        let metrics = Metrics {
            episodes: count("episodes_total", "Episodes finished")?,
            environment_steps: count("environment_steps_total", "Environment steps taken")?,
            snapshots_received: count("snapshots_received_total", received)?,
            episode_score: histogram("episode_score", score, SCORE_BUCKETS)?,
            experience_rows: count("experience_rows_total", experience)?,
            job_duration: histogram("job_duration_seconds", duration, SECONDS_BUCKETS)?,
            select_seconds: seconds("select_seconds_total", "Time spent choosing actions")?,
            physics_seconds: seconds("physics_seconds_total", "Time spent in the physics")?,
            runs: register(&registry, runs)?,
            jobs: labeled("jobs_total", "Jobs by how they ended", "outcome")?,
            rejected_messages: labeled("rejected_messages_total", rejected, "reason")?,
            registry: registry.clone(),
        };
        for outcome in OUTCOMES {
            metrics.jobs.with_label_values(&[outcome]);
        }
        Ok(metrics)
    }

    /// Counts a job by its end: `scored` or `played` if the learner acknowledged the results,
    /// `abandoned` if it refused or never fetched them or this evaluator leaves, else `failed`.
    pub fn job(&self, outcome: &'static str) {
        self.jobs.with_label_values(&[outcome]).inc();
    }

    /// Counts a message that the evaluator did not use. The reasons are a fixed list, because the
    /// registry keeps every label.
    pub fn rejected(&self, reason: &'static str) {
        self.rejected_messages.with_label_values(&[reason]).inc();
    }
}

fn register<M: Collector + Clone + 'static>(
    registry: &Registry,
    metric: M,
) -> prometheus::Result<M> {
    registry.register(Box::new(metric.clone()))?;
    Ok(metric)
}
