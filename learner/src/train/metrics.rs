//! What Prometheus can ask about gradient steps, and how a metric of the learner is made.

use std::time::Duration;

use prometheus::core::{Collector, Desc};
use prometheus::proto::MetricFamily;
use prometheus::{
    Counter, Gauge, GaugeVec, Histogram, HistogramOpts, IntCounter, IntCounterVec, IntGauge,
    IntGaugeVec, Opts, Registry, exponential_buckets,
};
use quad_algorithms::Metric;

use super::held_out;

/// Shortest gradient step that the histogram tells apart, and how many doublings follow it: 1 ms to
/// 2 s.
const SHORTEST_STEP: f64 = 1e-3;
const STEP_BUCKETS: usize = 12;

/// Gradient steps and what they measured. Updating one is an atomic store, so the training thread
/// may.
#[derive(Clone, Debug)]
pub(crate) struct TrainingMetrics {
    pub gradient_steps: IntCounter,
    pub step_duration: Histogram,
    pub saving_seconds: Counter,
    pub diverged: IntGauge,
    /// What the algorithm measures, in its order.
    pub algorithm: Vec<(&'static Metric, MaybeGauge)>,
    /// What it measures on held-out episodes, in its order.
    held_out: Vec<MaybeGauge>,
}

/// A gauge that is there as long as it has a value.
#[derive(Clone, Debug)]
pub(crate) struct MaybeGauge(Gauge);

impl MaybeGauge {
    fn new(name: &str, help: &str) -> prometheus::Result<Self> {
        let gauge = Gauge::new(full(name), help)?;
        gauge.set(f64::NAN);
        Ok(Self(gauge))
    }

    /// Its value, if it has one.
    pub fn get(&self) -> Option<f64> {
        Some(self.0.get()).filter(|value| !value.is_nan())
    }

    fn set(&self, value: Option<f32>) {
        self.0.set(value.map_or(f64::NAN, f64::from));
    }
}

impl Collector for MaybeGauge {
    fn desc(&self) -> Vec<&Desc> {
        self.0.desc()
    }

    fn collect(&self) -> Vec<MetricFamily> {
        self.get().map(|_| self.0.collect()).unwrap_or_default()
    }
}

impl TrainingMetrics {
    /// Makes them, for a run of so many steps whose algorithm measures that.
    pub fn new(
        make: &Registrar,
        target_steps: u64,
        measured: &'static [Metric],
    ) -> prometheus::Result<Self> {
        let target = make.count("gradient_steps_target", "Gradient steps that this run will do")?;
        target.set(i64::try_from(target_steps).unwrap_or(i64::MAX));
        let buckets = exponential_buckets(SHORTEST_STEP, 2.0, STEP_BUCKETS)?;
        let duration =
            HistogramOpts::new(full("step_duration_seconds"), "Wall time of one gradient step");
        let saving = "Time that the training thread spent on copying its state and its policy instead of training";
        let gauge = |name: &str, help: &str| make.add(MaybeGauge::new(name, help));
        let gauges = measured.iter().map(|metric| Ok((metric, gauge(metric.name, metric.help)?)));
        let help = |metric: &Metric| {
            format!("On held-out episodes, with the weights as they are: {}", metric.help)
        };
        let held_out = measured.iter().map(|metric| gauge(&held_out::name(metric), &help(metric)));
        Ok(Self {
            held_out: held_out.collect::<prometheus::Result<_>>()?,
            gradient_steps: make.counter("gradient_steps_total", "Gradient steps done")?,
            step_duration: make.add(Histogram::with_opts(duration.buckets(buckets)))?,
            saving_seconds: make.add(Counter::new(full("saving_seconds_total"), saving))?,
            diverged: make
                .count("diverged", "1 once training has met a number that is not finite, else 0")?,
            algorithm: gauges.collect::<prometheus::Result<_>>()?,
        })
    }

    /// Takes in one gradient step: what it measured, in the algorithm's order.
    pub fn observe(&self, values: &[Option<f32>], duration: Duration) {
        self.gradient_steps.inc();
        self.step_duration.observe(duration.as_secs_f64());
        for ((_, gauge), value) in self.algorithm.iter().zip(values) {
            gauge.set(*value);
        }
    }

    /// Takes in what was measured on held-out episodes.
    pub fn observe_held_out(&self, values: &[Option<f32>]) {
        self.held_out.iter().zip(values).for_each(|(gauge, value)| gauge.set(*value));
    }
}

/// Makes metrics of the learner and registers them.
pub(crate) struct Registrar {
    pub registry: Registry,
}

impl Registrar {
    pub fn add<M: Collector + Clone + 'static>(
        &self,
        made: prometheus::Result<M>,
    ) -> prometheus::Result<M> {
        let metric = made?;
        self.registry.register(Box::new(metric.clone()))?;
        Ok(metric)
    }

    pub fn counter(&self, name: &str, help: &str) -> prometheus::Result<IntCounter> {
        self.add(IntCounter::new(full(name), help))
    }

    pub fn gauge(&self, name: &str, help: &str) -> prometheus::Result<Gauge> {
        self.add(Gauge::new(full(name), help))
    }

    pub fn count(&self, name: &str, help: &str) -> prometheus::Result<IntGauge> {
        self.add(IntGauge::new(full(name), help))
    }

    /// A counter with a label.
    pub fn counters(
        &self,
        name: &str,
        help: &str,
        label: &str,
    ) -> prometheus::Result<IntCounterVec> {
        self.add(IntCounterVec::new(Opts::new(full(name), help), &[label]))
    }

    /// A gauge of whole numbers with a label.
    pub fn counts(&self, name: &str, help: &str, label: &str) -> prometheus::Result<IntGaugeVec> {
        self.add(IntGaugeVec::new(Opts::new(full(name), help), &[label]))
    }

    /// A gauge with a label.
    pub fn gauges(&self, name: &str, help: &str, label: &str) -> prometheus::Result<GaugeVec> {
        self.add(GaugeVec::new(Opts::new(full(name), help), &[label]))
    }
}

fn full(name: &str) -> String {
    format!("quad_learner_{name}")
}
