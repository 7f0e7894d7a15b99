//! Tests: an update of each phase against an independent implementation (tests/golden/README.md),
//! and what it learns from.

use super::*;
use crate::golden::{
    Golden, batch, check_update, context, golden_tests, goldens, items, load, table,
};
use quad_dataset::{Arrays, Transitions};
use quad_nn::{Precision, Weighted};
use quad_policy::{Header, load_policy};
use std::sync::Arc;

fn config(golden: &Golden) -> Config {
    Config::of(&table(golden)).unwrap()
}

fn start(golden: &Golden, device: &Device) -> Sfbc {
    let mut sfbc = Sfbc::new(config(golden), context(golden, device)).unwrap();
    // Slower frequencies than a run has.
    let (shape, frequencies) = (sfbc.shape.actor(), golden.input("frequencies", &Device::Cpu));
    let weights = initial(&shape.layout(), &sfbc.context, 0).unwrap();
    sfbc.actor = TrainState::new(ScoreNetwork::new(shape, weights, frequencies), 0.0).unwrap();
    load(golden, sfbc.parts());
    sfbc
}

fn check(golden: &Golden, device: &Device) {
    let (mut sfbc, step) = (start(golden, device), golden.count("/step") as u64);
    check_candidates(golden, &sfbc);
    let batch = batch(golden, &sfbc.context);
    let measured = match sfbc.phase(step) {
        (Phase::Behavior, steps) => {
            let t =
                golden.inputs["t"].to_vec1::<f32>().unwrap().into_iter().map(f64::from).collect();
            let noise = NoiseInTime { t, epsilon: golden.input("epsilon", device) };
            golden.close("noisy_actions", &noise.noisy(&batch.actions).unwrap());
            sfbc.clone_behavior(&batch, &noise, steps)
        }
        (Phase::Critic(round), steps) => sfbc.learn_returns(&batch, &items(golden), round, steps),
        (Phase::Planning(items), _) => {
            let noise = golden.input("planning_noise", device).flatten(0, 1).unwrap();
            sfbc.value(items.clone(), &noise).unwrap();
            sfbc.plan(items)
        }
    };
    check_update(golden, METRICS, &measured.unwrap(), sfbc.parts().save().unwrap());
}

/// What the published networks draw, and what they say of it; and how the policy chooses.
fn check_candidates(golden: &Golden, sfbc: &Sfbc) {
    let (policy, tensors) = sfbc.policy().unwrap();
    let file = Header::new(policy.clone(), ()).to_safetensors(&tensors).unwrap();
    load_policy(&file, Precision::F32).unwrap();
    let PolicyConfig::Score { choice, .. } = policy else { panic!("{policy:?}") };
    let rule = Rule::Average { temperature: 0.1, actions: 3 };
    assert_eq!(choice, Choice { candidates: 6, value: Aggregate::Mean, rule });
    let device = &sfbc.context.device;
    let observations = golden.input("select_observations", device);
    let noise = golden.input("select_noise", device).flatten(0, 1).unwrap();
    let drawn = sfbc.actor.network.sample(&sfbc.solver, &observations, &noise).unwrap();
    golden.close("select.candidates", &drawn);
    golden.close("select.q", &sfbc.critic.network.detach().values(&observations, &drawn).unwrap());
}

golden_tests!("sfbc", check);

/// Four episodes: of two steps, terminating; of one; of three, cut off; of one more.
fn small(
    golden: &Golden,
    changes: impl FnOnce(&mut Config),
) -> std::result::Result<Sfbc, AlgorithmError> {
    let transitions = Transitions::of(Arrays {
        observation_dim: 1,
        action_dim: 1,
        observations: (0..7).map(|row| row as f32).collect(),
        actions: vec![0.5; 7],
        rewards: vec![1.0, 2.0, 5.0, 0.0, 0.0, 4.0, 7.0],
        next_observations: (1..8).map(|row| row as f32).collect(),
        terminals: vec![false, true, true, false, false, false, true],
        timeouts: vec![false, false, false, false, false, true, false],
    });
    let mut config = config(golden);
    config.shortest_episode = Count(2);
    changes(&mut config);
    let transitions = Arc::new(transitions.unwrap());
    Sfbc::new(
        config,
        Context { transitions, batch_size: 2, total_steps: 20, ..context(golden, &Device::Cpu) },
    )
}

#[test]
fn it_learns_from_episodes_that_are_long_enough() {
    let golden = goldens("sfbc").remove(0);
    let sfbc = small(&golden, |_| ()).unwrap();
    assert_eq!(
        (&sfbc.items[..], &sfbc.returns.episodes[..]),
        (&[0, 1, 3, 4, 5][..], &[0..2, 2..5][..])
    );
    let refused = small(&golden, |config| config.shortest_episode = Count(9)).err().unwrap();
    assert!(
        refused.to_string().contains("9 transitions")
            && refused.hint().contains("shortest_episode"),
        "{refused}"
    );
}

#[test]
fn each_phase_does_its_part() {
    let golden = goldens("sfbc").remove(0);
    let mut sfbc = small(&golden, |_| ()).unwrap();
    assert_eq!(sfbc.phases(), [0, 6, 10, 16]);
    let first: Vec<f32> = sfbc.critic.network.weights().values().to_vec1().unwrap();
    let mut planned = Vec::new();
    for step in 0..20 {
        let numbers = |x: &Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let state = |sfbc: &Sfbc| {
            let networks = [sfbc.actor.network.weights(), sfbc.critic.network.weights()];
            networks
                .map(|weights| numbers(weights.values()))
                .into_iter()
                .chain([numbers(&sfbc.returns.targets)])
                .collect::<Vec<_>>()
        };
        let before = state(&sfbc);
        if let (Phase::Planning(items), _) = sfbc.phase(step) {
            planned.extend(items);
        }
        let measured = sfbc.update(step, &[0, 1]).unwrap();
        let names = Vec::from_iter(measured.iter().map(|(name, _)| *name));
        let expected: &[&str] = match step {
            ..6 => &["bc_loss"],
            // Six steps plan five states: the first of them plans none.
            10 => &[],
            11..16 => &["v_mean"],
            _ => &["critic_loss", "q_mean"],
        };
        assert_eq!(names, expected, "step {step}");
        let after = state(&sfbc);
        let moved: Vec<bool> =
            before.iter().zip(&after).map(|(before, after)| before != after).collect();
        assert_eq!(
            moved,
            [step < 6, (6..10).contains(&step) || step >= 16, step == 15],
            "step {step}"
        );
        if step == 16 {
            // One step from where the first began, with new moments.
            let farthest =
                after[1].iter().zip(&first).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max);
            assert!(farthest <= 1.001 * *sfbc.config.critic_learning_rate, "{farthest}");
        }
    }
    assert_eq!(planned, [0, 1, 2, 3, 4], "each state once");
}

#[test]
fn what_cannot_be_is_refused_before_it_starts() {
    let golden = goldens("sfbc").remove(0);
    for (key, value, said) in [
        ("averaged", toml::Value::from(7), "at most candidates"),
        ("evaluations", toml::Value::from(0), "whole number"),
        ("planning_temperature", toml::Value::from(0.0), "above 0"),
    ] {
        let mut table = table(&golden);
        table.insert(key.to_owned(), value);
        let error = (DEFINITION.check)(&table).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
    let mut table = table(&golden);
    table["actor"].as_table_mut().unwrap().insert("norm".to_owned(), true.into());
    assert!((DEFINITION.check)(&table).unwrap_err().to_string().contains("actor.norm"));
}
