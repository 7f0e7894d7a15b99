//! Tests of `live/metrics.rs`.

use super::*;

#[test]
fn every_series_carries_the_run_and_a_help_text() {
    let run = Name::new("a-run").unwrap();
    let measured = quad_algorithms::ALGORITHMS[0].metrics;
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
