//! What Prometheus can ask the learner; docs/metrics.md explains each of them.

use std::collections::HashMap;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use prometheus::core::Collector;
use prometheus::process_collector::ProcessCollector;
use prometheus::{
    Gauge, GaugeVec, Histogram, HistogramOpts, IntCounter, IntCounterVec, IntGauge, IntGaugeVec, Opts, Registry,
    exponential_buckets,
};
use quad_protocol::{Name, Progress};

use crate::agent::StepMetrics;

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
    /// Messages from the wire that were not accepted.
    pub rejected: IntCounterVec,
}

/// Gradient steps and what they measured.
#[derive(Clone, Debug)]
#[allow(missing_docs)] // each has its help text below
pub struct TrainingMetrics {
    pub gradient_steps: IntCounter,
    pub gradient_steps_target: IntGauge,
    pub step_duration: Histogram,
    pub critic_loss: Gauge,
    pub bc_loss: Gauge,
    pub actor_loss: Gauge,
    pub eta: Gauge,
    pub lambda_mean: Gauge,
    pub q_mean: Gauge,
    pub nu_squared: Gauge,
    pub critic_gradient_norm: Gauge,
    pub actor_gradient_norm: Gauge,
    pub learning_rate: Gauge,
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
    pub episodes_pending: IntGauge,
    pub scores_recorded: IntCounter,
    pub scores_duplicate: IntCounter,
    pub score: Gauge,
    pub step: IntGauge,
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
    pub fn new(run: &Name, target_steps: u64) -> prometheus::Result<(Self, Registry)> {
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
            critic_loss: make.gauge("critic_loss", "Critic loss of the last step (Eq. 20)")?,
            bc_loss: make.gauge("bc_loss", "Behaviour-cloning loss of the last step (first term of Eq. 19)")?,
            actor_loss: make.gauge("actor_loss", "Actor loss of the last step (Eq. 19)")?,
            eta: make.gauge("eta", "Behaviour-cloning strength eta after the last step (Eq. 19)")?,
            lambda_mean: make.gauge("lambda_mean", "Mean uncertainty weight lambda over the last batch (Eq. 24)")?,
            q_mean: make.gauge("q_mean", "Mean critic target y of the last batch (Eq. 20)")?,
            nu_squared: make
                .gauge("nu_squared", "Moving average of the variance of the mean alignment over a batch (Eq. 23)")?,
            critic_gradient_norm: make
                .gauge("critic_gradient_norm", "Norm of the critics' gradient before clipping, last step")?,
            actor_gradient_norm: make
                .gauge("actor_gradient_norm", "Norm of the actor's gradient before clipping, last step")?,
            learning_rate: make.gauge("learning_rate", "Learning rate of the actor at the last step")?,
        };
        training.gradient_steps_target.set(i64::try_from(target_steps).unwrap_or(i64::MAX));
        let outcomes = Opts::new(full("jobs_total"), "Evaluation jobs by what became of them");
        let jobs = make.add(IntCounterVec::new(outcomes, &["outcome"]))?;
        let evaluation = EvaluationMetrics {
            snapshots_published: make.counter("snapshots_published_total", "Snapshots handed to evaluation")?,
            snapshot_bytes: make.count("snapshot_bytes", "Size of the newest snapshot")?,
            jobs_handed_out: jobs.get_metric_with_label_values(&["handed_out"])?,
            jobs_completed: jobs.get_metric_with_label_values(&["completed"])?,
            jobs_expired: jobs.get_metric_with_label_values(&["expired"])?,
            episodes_pending: make.count("episodes_pending", "Episodes of evaluations that have no score yet")?,
            scores_recorded: make.counter("scores_recorded_total", "Episodes scored, each counted once")?,
            scores_duplicate: make.counter("scores_duplicate_total", "Scores delivered for episodes that had one")?,
            score: make.gauge("evaluation_score", "Mean normalised score of the newest complete evaluation")?,
            step: make.count("evaluation_step", "Gradient step of the newest complete evaluation")?,
        };
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
        Ok((Self { training, evaluation, evaluators, rejected }, registry))
    }

    /// Counts a message that was not accepted.
    pub fn reject(&self, reason: &str) {
        self.rejected.with_label_values(&[reason]).inc();
    }
}

impl TrainingMetrics {
    /// Takes in one gradient step.
    pub fn observe(&self, step: &StepMetrics, duration: Duration) {
        self.gradient_steps.inc();
        self.step_duration.observe(duration.as_secs_f64());
        let pairs = [
            (&self.critic_loss, step.critic_loss),
            (&self.bc_loss, step.bc_loss),
            (&self.actor_loss, step.actor_loss),
            (&self.eta, step.eta),
            (&self.lambda_mean, step.lambda_mean),
            (&self.q_mean, step.q_mean),
            (&self.nu_squared, step.nu_squared),
            (&self.critic_gradient_norm, step.critic_gradient_norm),
            (&self.actor_gradient_norm, step.actor_gradient_norm),
            (&self.learning_rate, step.learning_rate),
        ];
        for (gauge, value) in pairs {
            gauge.set(value.into());
        }
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
        let (metrics, registry) = Metrics::new(&run, 10).unwrap();
        metrics.reject("truncated");
        let progress = Progress {
            evaluator: Name::new("e1").unwrap(),
            run,
            job: 1,
            step: 2,
            episodes_done: 0,
            episodes_total: 5,
            environment_steps: 77,
            episodes: 3,
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
