//! What Prometheus can ask the learner; docs/metrics.md explains each of them.

use std::collections::HashMap;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use prometheus::core::Collector;
use prometheus::process_collector::ProcessCollector;
use prometheus::{
    Counter, Gauge, GaugeVec, Histogram, HistogramOpts, IntCounter, IntCounterVec, IntGauge, IntGaugeVec, Opts,
    Registry, exponential_buckets,
};
use quad_protocol::{Name, Progress};

use crate::algorithms::Metric;
use crate::trouble::Saved;

/// Shortest gradient step that the histogram tells apart, and how many doublings follow it: 1 ms to 2 s.
const SHORTEST_STEP: f64 = 1e-3;
const STEP_BUCKETS: usize = 12;

/// All metrics of one learner. Cheap to clone; updating one is an atomic store, so the training thread may.
#[derive(Clone, Debug)]
pub struct Metrics {
    /// Of the gradient steps.
    pub training: TrainingMetrics,
    /// Of snapshots, jobs and scores.
    pub evaluation: EvaluationMetrics,
    /// Of what the evaluators say about themselves.
    pub evaluators: EvaluatorMetrics,
    /// Of what is kept on disk.
    pub disk: DiskMetrics,
    /// Messages from the wire that were not accepted.
    pub rejected: IntCounterVec,
    /// For how long connections that send too much were not read.
    pub held_back_seconds: Counter,
}

/// Gradient steps and what they measured.
#[derive(Clone, Debug)]
#[allow(missing_docs)] // each has its help text below
pub struct TrainingMetrics {
    pub gradient_steps: IntCounter,
    pub gradient_steps_target: IntGauge,
    pub step_duration: Histogram,
    pub saving_seconds: Counter,
    pub diverged: IntGauge,
    /// What the algorithm measures, in its order.
    pub algorithm: Vec<(&'static Metric, Gauge)>,
}

/// Snapshots, jobs and scores.
#[derive(Clone, Debug)]
#[allow(missing_docs)]
pub struct EvaluationMetrics {
    pub snapshots_published: IntCounter,
    pub snapshot_bytes: IntGauge,
    pub jobs_handed_out: IntCounter,
    pub jobs_completed: IntCounter,
    pub jobs_expired: IntCounter,
    pub jobs_handed_back: IntCounter,
    pub jobs_failed: IntCounter,
    pub episodes_pending: IntGauge,
    pub episodes_missing: IntGauge,
    audits: IntCounterVec,
    pub audits_missed: IntCounter,
    pub scores_recorded: IntCounter,
    pub scores_duplicate: IntCounter,
    pub score: Gauge,
    pub step: IntGauge,
}

/// Checkpoints, and how the disk takes them.
#[derive(Clone, Debug)]
#[allow(missing_docs)]
pub struct DiskMetrics {
    pub checkpoint_step: IntGauge,
    pub checkpoint_timestamp: Gauge,
    pub checkpoint_bytes: IntGauge,
    trouble: IntGaugeVec,
}

/// What the evaluators' progress messages say, labelled by evaluator.
#[derive(Clone, Debug)]
#[allow(missing_docs)]
pub struct EvaluatorMetrics {
    pub present: IntGauge,
    episodes: IntGaugeVec,
    environment_steps: IntGaugeVec,
    last_seen: GaugeVec,
}

/// Makes a metric and registers it.
struct Registrar {
    registry: Registry,
}

impl Registrar {
    fn add<M: Collector + Clone + 'static>(&self, made: prometheus::Result<M>) -> prometheus::Result<M> {
        let metric = made?;
        self.registry.register(Box::new(metric.clone()))?;
        Ok(metric)
    }

    fn counter(&self, name: &str, help: &str) -> prometheus::Result<IntCounter> {
        self.add(IntCounter::new(full(name), help))
    }

    fn gauge(&self, name: &str, help: &str) -> prometheus::Result<Gauge> {
        self.add(Gauge::new(full(name), help))
    }

    fn count(&self, name: &str, help: &str) -> prometheus::Result<IntGauge> {
        self.add(IntGauge::new(full(name), help))
    }
}

fn full(name: &str) -> String {
    format!("quad_learner_{name}")
}

impl Metrics {
    /// Makes them all, in a registry that labels each with the run.
    pub fn new(run: &Name, target_steps: u64, measured: &'static [Metric]) -> prometheus::Result<(Self, Registry)> {
        let labels = HashMap::from([("run".to_owned(), run.to_string())]);
        let registry = Registry::new_custom(None, Some(labels))?;
        registry.register(Box::new(ProcessCollector::for_self()))?;
        let make = Registrar { registry: registry.clone() };
        let buckets = exponential_buckets(SHORTEST_STEP, 2.0, STEP_BUCKETS)?;
        let duration =
            HistogramOpts::new(full("step_duration_seconds"), "Wall time of one gradient step").buckets(buckets);
        let training = TrainingMetrics {
            gradient_steps: make.counter("gradient_steps_total", "Gradient steps done")?,
            gradient_steps_target: make.count("gradient_steps_target", "Gradient steps that this run will do")?,
            step_duration: make.add(Histogram::with_opts(duration))?,
            saving_seconds: make.add(Counter::new(
                full("saving_seconds_total"),
                "Time that the training thread spent on copying its state and its policy instead of training",
            ))?,
            diverged: make.count("diverged", "1 once training has met a number that is not finite, else 0")?,
            algorithm: measured
                .iter()
                .map(|metric| Ok((metric, make.gauge(metric.name, metric.help)?)))
                .collect::<prometheus::Result<_>>()?,
        };
        training.gradient_steps_target.set(i64::try_from(target_steps).unwrap_or(i64::MAX));
        let outcomes = Opts::new(full("jobs_total"), "Evaluation jobs by outcome");
        let jobs = make.add(IntCounterVec::new(outcomes, &["outcome"]))?;
        let audits = make.add(IntCounterVec::new(
            Opts::new(full("audits_total"), "Episodes that were to be scored a second time, by outcome"),
            &["outcome"],
        ))?;
        let evaluation = EvaluationMetrics {
            snapshots_published: make.counter("snapshots_published_total", "Snapshots handed to evaluation")?,
            snapshot_bytes: make.count("snapshot_bytes", "Size of the newest snapshot")?,
            jobs_handed_out: jobs.get_metric_with_label_values(&["handed_out"])?,
            jobs_completed: jobs.get_metric_with_label_values(&["completed"])?,
            jobs_expired: jobs.get_metric_with_label_values(&["expired"])?,
            jobs_handed_back: jobs.get_metric_with_label_values(&["handed_back"])?,
            jobs_failed: jobs.get_metric_with_label_values(&["failed"])?,
            audits_missed: audits.get_metric_with_label_values(&["missed"])?,
            audits,
            episodes_missing: make.count(
                "episodes_missing",
                "Episodes that are not handed out any more, after too many failed attempts",
            )?,
            episodes_pending: make.count("episodes_pending", "Episodes of evaluations that have no score yet")?,
            scores_recorded: make.counter("scores_recorded_total", "Episodes scored, each counted once")?,
            scores_duplicate: make.counter("scores_duplicate_total", "Scores delivered for episodes that had one")?,
            score: make.gauge("evaluation_score", "Mean normalised score of the newest complete evaluation")?,
            step: make.count("evaluation_step", "Gradient step of the newest complete evaluation")?,
        };
        let disk = DiskMetrics {
            checkpoint_step: make.count("checkpoint_step", "Gradient step of the newest checkpoint on disk")?,
            checkpoint_timestamp: make
                .gauge("checkpoint_timestamp_seconds", "When the newest checkpoint was written")?,
            checkpoint_bytes: make.count("checkpoint_bytes", "Size of the newest checkpoint")?,
            trouble: make.add(IntGaugeVec::new(
                Opts::new(full("disk_trouble"), "1 while the disk does not take what is to be kept, else 0"),
                &["what"],
            ))?,
        };
        for what in [Saved::Run, Saved::Scores] {
            disk.trouble(what);
        }
        // From the beginning, so that the first of them is an increase.
        for agree in [true, false] {
            evaluation.audits(agree);
        }
        let labelled = |name: &str, help: &str| Opts::new(full(name), help);
        let evaluators = EvaluatorMetrics {
            present: make.count("evaluators", "Evaluators present")?,
            episodes: make.add(IntGaugeVec::new(
                labelled("evaluator_episodes", "Episodes run by an evaluator since it started, as it says"),
                &["evaluator"],
            ))?,
            environment_steps: make.add(IntGaugeVec::new(
                labelled(
                    "evaluator_environment_steps",
                    "Environment steps of an evaluator since it started, as it says",
                ),
                &["evaluator"],
            ))?,
            last_seen: make.add(GaugeVec::new(
                labelled("evaluator_last_seen_timestamp_seconds", "When an evaluator last told its progress"),
                &["evaluator"],
            ))?,
        };
        let reasons = Opts::new(full("rejected_messages_total"), "Messages that were not accepted, by reason");
        let rejected = make.add(IntCounterVec::new(reasons, &["reason"]))?;
        let held_back_seconds = make.add(Counter::new(
            full("held_back_seconds_total"),
            "Time for which connections that sent too much were not read",
        ))?;
        Ok((Self { training, evaluation, evaluators, disk, rejected, held_back_seconds }, registry))
    }

    /// Counts a message that was not accepted.
    pub fn reject(&self, reason: &str) {
        self.rejected.with_label_values(&[reason]).inc();
    }
}

impl TrainingMetrics {
    /// Takes in one gradient step: what it measured, in the algorithm's order.
    pub fn observe(&self, values: &[f32], duration: Duration) {
        self.gradient_steps.inc();
        self.step_duration.observe(duration.as_secs_f64());
        for ((_, gauge), value) in self.algorithm.iter().zip(values) {
            gauge.set(f64::from(*value));
        }
    }
}

impl EvaluationMetrics {
    /// Episodes whose two scores agree, or differ.
    pub fn audits(&self, agree: bool) -> IntCounter {
        self.audits.with_label_values(&[if agree { "agree" } else { "differ" }])
    }
}

impl DiskMetrics {
    /// Whether the disk does not take that.
    pub fn trouble(&self, what: Saved) -> IntGauge {
        self.trouble.with_label_values(&[what.label()])
    }
}

impl EvaluatorMetrics {
    /// Takes in what an evaluator says about itself.
    pub fn observe(&self, progress: &Progress) {
        let label = [progress.evaluator.as_str()];
        let count = |value: u64| i64::try_from(value).unwrap_or(i64::MAX);
        self.episodes.with_label_values(&label).set(count(progress.episodes));
        self.environment_steps.with_label_values(&label).set(count(progress.environment_steps));
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        self.last_seen.with_label_values(&label).set(now.as_secs_f64());
    }

    /// Drops the series of an evaluator that is long gone.
    pub fn forget(&self, evaluator: &Name) {
        let label = [evaluator.as_str()];
        // An error means that there was no such series, which is what is wanted.
        self.episodes.remove_label_values(&label).ok();
        self.environment_steps.remove_label_values(&label).ok();
        self.last_seen.remove_label_values(&label).ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_series_carries_the_run_and_a_help_text() {
        let run = Name::new("a-run").unwrap();
        let measured = crate::algorithms::ALGORITHMS[0].metrics;
        let (metrics, registry) = Metrics::new(&run, 10, measured).unwrap();
        metrics.reject("truncated");
        let progress = Progress {
            evaluator: Name::new("e1").unwrap(),
            run,
            incarnation: 1,
            job: 1,
            step: 2,
            episodes_done: 0,
            episodes_total: 5,
            steps_done: 7,
            environment_steps: 77,
            episodes: 3,
            proof: quad_protocol::Hash::of(b"none"),
        };
        metrics.evaluators.observe(&progress);
        let families = registry.gather();
        let has_run = |metric: &prometheus::proto::Metric| metric.get_label().iter().any(|l| l.value() == "a-run");
        assert!(families.iter().all(|family| !family.help().is_empty() && family.get_metric().iter().all(has_run)));
        let steps = |families: &[prometheus::proto::MetricFamily]| {
            let family = families.iter().find(|f| f.name() == "quad_learner_evaluator_environment_steps");
            family.map(|family| family.get_metric()[0].get_gauge().get_value())
        };
        assert_eq!(steps(&families), Some(77.0));
        metrics.evaluators.forget(&progress.evaluator);
        assert_eq!(steps(&registry.gather()), None, "series of evaluators that are gone do not pile up");
    }
}
