//! Prometheus metrics of gradient steps.

use std::time::Duration;

use prometheus::core::{Collector, Desc};
use prometheus::proto::MetricFamily;
use prometheus::{
    Counter, Gauge, Histogram, HistogramOpts, IntCounter, IntGauge, Registry, exponential_buckets,
};
use quad_algorithms::Metric;

use super::results::held_out_name;

/// Shortest gradient step that the histogram tells apart, and number of doublings after it: 1 ms to
/// 2 s.
const SHORTEST_STEP: f64 = 1e-3;
const STEP_BUCKETS: usize = 12;

/// Declares a struct of registered metrics: `field: Type("name", "help")`, or `("name", "help",
/// "label")` for the types with a label.
macro_rules! metrics {
    (@new $Type:ident, $name:literal, $help:literal) => {
        prometheus::$Type::new(concat!("quad_learner_", $name), $help)
    };
    (@new $Type:ident, $name:literal, $help:literal, $label:literal) => {
        prometheus::$Type::new(
            prometheus::Opts::new(concat!("quad_learner_", $name), $help), &[$label])
    };
    ($(#[$meta:meta])* $Name:ident {
        $($field:ident: $Type:ident($($argument:literal),+),)+
    }) => {
        $(#[$meta])*
        #[derive(Clone, Debug)]
        pub(crate) struct $Name {
            $(pub $field: prometheus::$Type,)+
        }

        impl $Name {
            pub fn new(registry: &prometheus::Registry) -> prometheus::Result<Self> {
                Ok(Self {
                    $($field: $crate::train::register(
                        registry,
                        metrics!(@new $Type, $($argument),+),
                    )?,)+
                })
            }
        }
    };
}
pub(crate) use metrics;

/// Registers a new metric.
pub(crate) fn register<M: Collector + Clone + 'static>(
    registry: &Registry,
    metric: prometheus::Result<M>,
) -> prometheus::Result<M> {
    let metric = metric?;
    registry.register(Box::new(metric.clone()))?;
    Ok(metric)
}

metrics! {
    /// Metrics of experience that training has absorbed.
    OnlineMetrics {
        target: IntGauge("experience_rows_target", "Online environment steps that this run will do"),
        rows: IntGauge("experience_rows", "Online environment steps that training has absorbed"),
        episodes: IntGauge("experience_episodes", "Online episodes that training has absorbed"),
        left_out: IntCounter("experience_left_out_total", "Online episodes with a number far outside the dataset's range"),
        differences: IntCounter("experience_differences_total", "Online episodes that came again with other bits"),
        episode_return: Gauge("online_return", "Return of the newest episode that training has absorbed"),
        score: Gauge("online_score", "Score of the newest episode that training has absorbed"),
        wait_seconds: Counter("experience_wait_seconds_total", "Time that training has waited for experience"),
    }
}

/// Metrics of gradient steps. An update is an atomic store.
#[derive(Clone, Debug)]
pub(crate) struct TrainingMetrics {
    pub gradient_steps: IntCounter,
    pub step_duration: Histogram,
    pub saving_seconds: Counter,
    pub diverged: IntGauge,
    /// The algorithm's metrics, in its order.
    pub algorithm: Vec<(&'static Metric, OptionalGauge)>,
    /// The algorithm's metrics on held-out episodes, in the same order.
    held_out: Vec<OptionalGauge>,
}

/// A gauge that is exposed as long as it has a value.
#[derive(Clone, Debug)]
pub(crate) struct OptionalGauge(Gauge);

impl OptionalGauge {
    fn new(registry: &Registry, name: &str, help: &str) -> prometheus::Result<Self> {
        let gauge = Gauge::new(full(name), help)?;
        gauge.set(f64::NAN);
        register(registry, Ok(Self(gauge)))
    }

    pub fn get(&self) -> Option<f64> {
        Some(self.0.get()).filter(|value| !value.is_nan())
    }

    fn set(&self, value: Option<f32>) {
        self.0.set(value.map_or(f64::NAN, f64::from));
    }
}

impl Collector for OptionalGauge {
    fn desc(&self) -> Vec<&Desc> {
        self.0.desc()
    }

    fn collect(&self) -> Vec<MetricFamily> {
        self.get().map(|_| self.0.collect()).unwrap_or_default()
    }
}

impl TrainingMetrics {
    /// Makes the metrics of a run of this many steps.
    pub fn new(
        registry: &Registry,
        target_steps: u64,
        metrics: &'static [Metric],
    ) -> prometheus::Result<Self> {
        let target = "Gradient steps that this run will do";
        let target = register(registry, IntGauge::new(full("gradient_steps_target"), target))?;
        target.set(i64::try_from(target_steps).unwrap_or(i64::MAX));
        let duration =
            HistogramOpts::new(full("step_duration_seconds"), "Wall time of one gradient step")
                .buckets(exponential_buckets(SHORTEST_STEP, 2.0, STEP_BUCKETS)?);
        let steps = IntCounter::new(full("gradient_steps_total"), "Gradient steps done");
        let saving = "Time that the training thread spent on copying its state and its policy instead of training";
        let diverged = "1 once training has met a number that is not finite, else 0";
        let (mut algorithm, mut held_out) = (Vec::new(), Vec::new());
        for metric in metrics {
            algorithm.push((metric, OptionalGauge::new(registry, metric.name, metric.help)?));
            let help =
                format!("On held-out episodes, with the weights as they are: {}", metric.help);
            held_out.push(OptionalGauge::new(registry, &held_out_name(metric), &help)?);
        }
        Ok(Self {
            gradient_steps: register(registry, steps)?,
            step_duration: register(registry, Histogram::with_opts(duration))?,
            saving_seconds: register(registry, Counter::new(full("saving_seconds_total"), saving))?,
            diverged: register(registry, IntGauge::new(full("diverged"), diverged))?,
            algorithm,
            held_out,
        })
    }

    /// Records a gradient step and its values, in the algorithm's order.
    pub fn observe(&self, values: &[Option<f32>], duration: Duration) {
        self.gradient_steps.inc();
        self.step_duration.observe(duration.as_secs_f64());
        self.algorithm.iter().zip(values).for_each(|((_, gauge), value)| gauge.set(*value));
    }

    pub fn observe_held_out(&self, values: &[Option<f32>]) {
        self.held_out.iter().zip(values).for_each(|(gauge, value)| gauge.set(*value));
    }
}

fn full(name: &str) -> String {
    format!("quad_learner_{name}")
}
