//! What is measured on held-out episodes, and what a number there may cost.

use super::*;

/// An agent of this algorithm, of such batches, over 30 other transitions than those that are
/// learned from, whose first reward is as given.
fn beside(algorithm: &str, batch_size: usize, reward: f32) -> Agent {
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

/// By the weights of the moment, in whatever order batches are taken, and without a trace in what
/// is trained.
#[test]
fn held_out_episodes_are_measured_and_not_learned_from() {
    for algorithm in ["quad", "iql"] {
        let agent = || {
            Agent::new(definition(algorithm).unwrap(), &small(algorithm).into(), context(20))
                .unwrap()
        };
        let ([mut alone, mut measured], mut held_out) =
            ([agent(), agent()], HeldOut::of(beside(algorithm, 8, 1.0), 8, 0, 20));
        let mut before = Vec::new();
        for _ in 0..5 {
            assert_eq!(
                alone.update(&[0, 1, 2, 3]).unwrap(),
                measured.update(&[0, 1, 2, 3]).unwrap()
            );
            let state = measured.save().unwrap();
            let values = held_out.measure(&state).unwrap();
            assert!(
                values != before && values == held_out.measure(&state).unwrap(),
                "{algorithm}: {values:?}"
            );

            let mut sampler = BatchSampler::new(30, 8, 0, 0);
            let batches = Vec::from_iter((0..4).map(|_| sampler.next_items().to_vec()));
            let mut sums = vec![0.0; values.len()];
            for batch in batches.iter().rev() {
                let mut fresh = beside(algorithm, 8, 1.0);
                fresh.load(&state).unwrap();
                let values = fresh.evaluate(batch).unwrap();
                sums.iter_mut()
                    .zip(values)
                    .for_each(|(sum, value)| *sum += f64::from(value.unwrap_or_default()));
            }
            for ((metric, value), sum) in measured.metrics().iter().zip(&values).zip(sums) {
                assert_eq!(value.is_some(), metric.held_out, "{metric:?}");
                assert!(
                    value.is_none_or(|value| (f64::from(value) - sum / 4.0).abs() < 1e-6),
                    "{metric:?}: {value:?}"
                );
            }
            before = values;
        }
        assert_eq!(alone.save().unwrap(), measured.save().unwrap());
    }
}

#[test]
fn an_outlier_in_a_held_out_episode_costs_the_metrics_that_it_is_in() {
    let agent =
        || Agent::new(definition("iql").unwrap(), &small("iql").into(), context(250)).unwrap();
    let held_out = HeldOut::of(beside("iql", 30, 3e19), 30, 0, 250);
    let result = run_agent(agent(), Some(held_out), plan(250, 0), false);
    assert_eq!(result.outcome.unwrap(), Outcome::Completed);
    for (row, step) in result.rows.iter().zip([100, 200, 250]) {
        let json = serde_json::to_value(row).unwrap();
        let has = |name: &str| json.get(name).is_some();
        assert_eq!(
            (row.step, has("held_out_value_loss"), has("held_out_critic_loss")),
            (step, true, false),
            "{json}"
        );
        assert!(has("critic_loss") && !json.to_string().contains("null"), "{json}");
    }
    let has = |name: &str| result.gauges.contains(name);
    assert!(
        has("critic_loss") && has("held_out_value_loss") && !has("held_out_critic_loss"),
        "{:?}",
        result.gauges
    );
    assert_eq!(result.metrics.diverged.get(), 0);
    let without = run_agent(agent(), None, plan(250, 0), false);
    assert!(
        without.checkpoint == result.checkpoint && !without.gauges.contains("held_out_value_loss")
    );
}

/// A row has measurements or has none: it does not repeat those of another.
#[test]
fn held_out_episodes_are_measured_a_hundred_times_in_a_run_and_at_its_end() {
    let held_out = |steps| HeldOut::of(beside("iql", 8, 1.0), 8, 0, steps);
    let due = |steps: u64, rows: &[u64]| -> Vec<u64> {
        let held_out = held_out(steps);
        rows.iter().copied().filter(|step| held_out.is_due(*step, *step == steps)).collect()
    };
    assert_eq!(due(20, &[20]), [20]);
    assert_eq!(due(1_050, &[100, 200, 1_000, 1_050]), [100, 200, 1_000, 1_050]);
    assert_eq!(due(25_000, &[100, 200, 300, 400, 600, 24_900, 25_000]), [300, 600, 24_900, 25_000]);
}
