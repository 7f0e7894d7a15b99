//! Tests: an update of each phase against an independent implementation (tests/golden/README.md),
//! and what the phases train.

use super::*;
use crate::golden::{
    Golden, batch, check_candidates, check_update, context, golden_tests, goldens, items, load,
    table,
};
use candle_core::Device;

fn start(golden: &Golden, device: &Device) -> Dtql {
    let mut dtql = Dtql::new(read(&table(golden)).unwrap(), context(golden, device)).unwrap();
    load(golden, dtql.parts());
    dtql
}

fn noise(golden: &Golden, device: &Device) -> Noise {
    let noising = |name: &str| Noising {
        levels: NoiseLevels::new(golden.inputs[&format!("{name}_sigma")].to_vec1().unwrap()),
        noise: golden.input(&format!("{name}_noise"), device),
    };
    Noise {
        cloning: noising("bc"),
        policy: golden.input("policy_noise", device),
        trust: noising("trust"),
    }
}

fn check(golden: &Golden, device: &Device) {
    let mut dtql = start(golden, device);
    check_choice(golden, &dtql);
    let (batch, noise) = (batch(golden, &dtql.context), noise(golden, device));
    if golden.expected.contains_key("policy_actions") {
        let distribution = dtql.actor.distribution(&batch.observations).unwrap();
        golden.close(
            "policy_actions",
            &distribution.draw(&noise.policy.unsqueeze(1).unwrap()).unwrap().actions,
        );
    }
    let measured = dtql.step(golden.count("/step") as u64, &batch, &noise).unwrap();
    check_update(golden, METRICS, &measured, dtql.parts().save().unwrap());
}

/// What the published networks say of the candidates, and how likely each is drawn.
fn check_choice(golden: &Golden, dtql: &Dtql) {
    let drawn = check_candidates(golden, dtql);
    let temperature = golden.config["agent"]["temperature"].as_f64().unwrap();
    let (candidates, rule) = (
        golden.count("/agent/candidates") as u32,
        Rule::Softmax { temperature: temperature as f32 },
    );
    assert_eq!(drawn.choice, Choice { candidates, value: Aggregate::Min, rule });
    let probabilities = candle_nn::ops::softmax(&(drawn.q / temperature).unwrap(), 1).unwrap();
    golden.close("select.probabilities", &probabilities);
}

golden_tests!("dtql", check);

/// A copy of its state, because weights are saved as views.
fn state(dtql: &mut Dtql) -> Vec<(String, Vec<f32>)> {
    let numbers = |x: &Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    dtql.parts()
        .save()
        .unwrap()
        .iter()
        .map(|(name, tensor)| (name.clone(), numbers(tensor)))
        .collect()
}

/// Two of five steps are pre-training where the phases are 2 : 3; in these the policy and what it
/// chooses by stay as they are.
#[test]
fn the_policy_begins_to_learn_when_pre_training_ends() {
    let golden = goldens("dtql").remove(0);
    let mut config: Config = read(&table(&golden)).unwrap();
    config.phases = Phases { pretraining: Steps(2), policy: Steps(3) };
    let context = Context { total_steps: 5, ..context(&golden, &Device::Cpu) };
    let mut dtql = Dtql::new(config, context).unwrap();
    assert_eq!(dtql.phases(), [0, 2]);
    let mut before = state(&mut dtql);
    for step in 0..5 {
        dtql.update(step, &items(&golden)).unwrap();
        let after = state(&mut dtql);
        for ((name, x), (_, y)) in
            before.iter().zip(&after).filter(|((name, _), _)| name.ends_with("3.bias"))
        {
            let waits = name.contains("actor") || name.starts_with("target");
            assert_eq!(x == y, waits && step < 2, "step {step}: {name}");
        }
        before = after;
    }
}

#[test]
fn the_noise_of_a_step_is_repeatable_and_the_two_losses_have_their_own() {
    let dtql = start(&goldens("dtql").remove(0), &Device::Cpu);
    let [first, again] = [dtql.noise(3).unwrap(), dtql.noise(3).unwrap()];
    assert_eq!(first.cloning.levels, again.cloning.levels);
    assert_ne!(first.cloning.levels, first.trust.levels);
    let numbers = |x: &Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert_eq!(numbers(&first.policy), numbers(&again.policy));
    assert!(numbers(&first.policy) != numbers(&first.trust.noise));
    assert!(numbers(&first.cloning.noise) != numbers(&first.trust.noise));
}
