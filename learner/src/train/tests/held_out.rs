//! Tests of the metrics on held-out episodes.

use quad_algorithms::Examples;

use super::*;

/// 30 other transitions than those of training, with this first reward.
fn held_out_examples(agent: &Agent, reward: f32) -> Examples {
    let observations = Vec::from_iter((0..30 * DIMS.0).map(|i| (i as f32).cos() / 2.0));
    let mut rewards = vec![1.0; 30];
    rewards[0] = reward;
    agent.examples(Arc::new(one_episode(observations, rewards))).unwrap()
}

#[test]
fn held_out_metrics_are_means_of_four_batches() {
    for algorithm in ["quad", "iql"] {
        let mut measured = agent(algorithm, 20);
        let training = measured.examples(Arc::new(transitions())).unwrap();
        let held_out = held_out_examples(&measured, 1.0);
        let batch = training.batch(&[0, 1, 2, 3]).unwrap();
        let mut before = Vec::new();
        let mut metrics = HeldOut::draw(&held_out, 8, 0, 20).unwrap();
        for _ in 0..5 {
            measured.update(&batch).unwrap();
            let values = metrics.measure(&measured).unwrap();
            assert_ne!(values, before, "{algorithm}");
            let mut sampler = BatchSampler::new(30, 8, 0, 0);
            let mut sums = vec![0.0; values.len()];
            for _ in 0..4 {
                let batch = held_out.batch(sampler.next_indices()).unwrap();
                for (sum, value) in sums.iter_mut().zip(measured.evaluate(&batch).unwrap()) {
                    *sum += f64::from(value.unwrap_or_default());
                }
            }
            for ((metric, value), sum) in measured.metrics().iter().zip(&values).zip(sums) {
                assert_eq!(value.is_some(), metric.held_out, "{metric:?}");
                let close = |value: f32| (f64::from(value) - sum / 4.0).abs() < 1e-6;
                assert!(value.is_none_or(close), "{metric:?}: {value:?}");
            }
            before = values;
        }
    }
}

#[test]
fn an_outlier_in_a_held_out_episode_drops_the_metrics_that_it_affects() {
    let trained = run_with(agent("iql", 250), schedule(250, 0), |training| {
        let examples = held_out_examples(&training.agent, 3e19);
        training.held_out = Some(HeldOut::draw(&examples, 30, 0, 250).unwrap());
    });
    assert_eq!(trained.outcome.unwrap(), Outcome::Completed);
    let (dropped, kept) = ("held_out_critic_loss", ["held_out_value_loss", "critic_loss"]);
    for (row, step) in trained.rows.iter().zip([100, 200, 250]) {
        let json = serde_json::to_value(row).unwrap();
        assert_eq!(row.step, step);
        assert!(json.get(dropped).is_none() && kept.iter().all(|name| json[name].is_number()));
    }
    let gauges = &trained.gauges;
    assert!(!gauges.contains(dropped) && kept.iter().all(|name| gauges.contains(*name)));
    assert_eq!(trained.metrics.diverged.get(), 0);
    let without = run(agent("iql", 250), schedule(250, 0));
    assert!(without.checkpoint == trained.checkpoint && !without.gauges.contains(kept[0]));
}

#[test]
fn held_out_episodes_are_measured_a_hundred_times_in_a_run_and_at_its_end() {
    let examples = held_out_examples(&agent("iql", 20), 1.0);
    for (steps, rows, expected) in [
        (20, &[20][..], &[20][..]),
        (1_050, &[100, 200, 1_000, 1_050], &[100, 200, 1_000, 1_050]),
        (25_000, &[100, 200, 300, 400, 600, 24_900, 25_000], &[300, 600, 24_900, 25_000]),
    ] {
        let held_out = HeldOut::draw(&examples, 8, 0, steps).unwrap();
        let due = rows.iter().copied().filter(|step| held_out.is_due(*step, *step == steps));
        assert_eq!(Vec::from_iter(due), expected);
    }
}
