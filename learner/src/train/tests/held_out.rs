//! Tests of the metrics on held-out episodes.

use super::*;

/// An agent over 30 other transitions than those of training, with this first reward.
fn held_out_agent(algorithm: &str, batch_size: usize, reward: f32) -> Agent {
    let (n, context) = (30, context(250));
    let (o, a) = (context.transitions.observation_dim(), context.transitions.action_dim());
    let numbers = |count: usize| (0..count).map(|i| (i as f32).sin() / 2.0).collect::<Vec<_>>();
    let arrays = Arrays {
        observation_dim: o,
        action_dim: a,
        observations: numbers(n * o),
        actions: numbers(n * a),
        rewards: (0..n).map(|row| if row == 0 { reward } else { 1.0 }).collect(),
        next_observations: numbers((n + 1) * o)[o..].to_vec(),
        terminals: vec![false; n],
        timeouts: (1..=n).map(|row| row == n).collect(),
    };
    let context =
        Context { transitions: Arc::new(Transitions::of(arrays).unwrap()), batch_size, ..context };
    Agent::new(definition(algorithm).unwrap(), &small(algorithm).into(), context).unwrap()
}

/// The result depends on the current weights, not on the order of batches, and changes nothing in
/// the agent that trains.
#[test]
fn held_out_episodes_are_measured_and_not_learned_from() {
    for algorithm in ["quad", "iql"] {
        let [mut alone, mut measured] = [(); 2].map(|()| agent(algorithm, 20));
        let mut held_out = HeldOut::of(held_out_agent(algorithm, 8, 1.0), 8, 0, 20);
        let mut before = Vec::new();
        for _ in 0..5 {
            let values = [&mut alone, &mut measured].map(|it| it.update(&[0, 1, 2, 3]).unwrap());
            assert_eq!(values[0], values[1]);
            let state = measured.save().unwrap();
            let values = held_out.measure(&state).unwrap();
            assert_ne!(values, before, "{algorithm}");
            assert_eq!(values, held_out.measure(&state).unwrap(), "{algorithm}");

            let mut sampler = BatchSampler::new(30, 8, 0, 0);
            let batches = Vec::from_iter((0..4).map(|_| sampler.next_indices().to_vec()));
            let mut sums = vec![0.0; values.len()];
            for batch in batches.iter().rev() {
                let mut fresh = held_out_agent(algorithm, 8, 1.0);
                fresh.load(&state).unwrap();
                for (sum, value) in sums.iter_mut().zip(fresh.evaluate(batch).unwrap()) {
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
        assert_eq!(alone.save().unwrap(), measured.save().unwrap());
    }
}

#[test]
fn an_outlier_in_a_held_out_episode_drops_the_metrics_that_it_affects() {
    let held_out = HeldOut::of(held_out_agent("iql", 30, 3e19), 30, 0, 250);
    let trained = run(agent("iql", 250), Some(held_out), schedule(250, 0), false);
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
    let without = run(agent("iql", 250), None, schedule(250, 0), false);
    assert!(without.checkpoint == trained.checkpoint && !without.gauges.contains(kept[0]));
}

#[test]
fn held_out_episodes_are_measured_a_hundred_times_in_a_run_and_at_its_end() {
    let due = |steps: u64, rows: &[u64]| -> Vec<u64> {
        let held_out = HeldOut::of(held_out_agent("iql", 8, 1.0), 8, 0, steps);
        rows.iter().copied().filter(|step| held_out.is_due(*step, *step == steps)).collect()
    };
    assert_eq!(due(20, &[20]), [20]);
    assert_eq!(due(1_050, &[100, 200, 1_000, 1_050]), [100, 200, 1_000, 1_050]);
    assert_eq!(due(25_000, &[100, 200, 300, 400, 600, 24_900, 25_000]), [300, 600, 24_900, 25_000]);
}
