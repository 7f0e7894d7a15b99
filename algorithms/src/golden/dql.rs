//! Tests: the update against an independent implementation (tests/golden/README.md).

use super::*;
use crate::algorithm::Algorithm;
use crate::golden::{
    Golden, batch, chain_noise, check_candidates, check_update, context, denoising, golden_tests,
    goldens, load, table,
};
use candle_core::Device;

fn start(golden: &Golden, device: &Device) -> Diffusion<Config> {
    let mut dql = read::<Config>(&table(golden)).unwrap().start(context(golden, device)).unwrap();
    load(golden, dql.parts());
    dql
}

fn noise(golden: &Golden, device: &Device) -> Noise {
    Noise {
        next: chain_noise(golden, "next_noise", device),
        policy: chain_noise(golden, "policy_noise", device),
        denoising: denoising(golden, device),
        raised: {
            let first = golden.inputs["first_critic"].to_vec1::<i64>().unwrap()[0] as u32;
            Tensor::new(&[first, 1 - first], device).unwrap()
        },
    }
}

fn check(golden: &Golden, device: &Device) {
    let mut dql = start(golden, device);
    let choice = check_candidates(golden, &dql).choice;
    let Diffusion { update, networks, .. } = &dql;
    let (batch, noise) = (batch(golden, &networks.context), noise(golden, device));
    let next = networks.target_actor.sample(&batch.next_observations, &noise.next).unwrap();
    golden.close("next_actions", &next);
    golden.close("targets", &update.targets(networks, &batch, &noise.next).unwrap());
    golden.close("noisy_actions", &networks.denoise(&batch, &noise.denoising).unwrap().0);
    let sampled = networks.actor.network.sample(&batch.observations, &noise.policy).unwrap();
    golden.close("policy_actions", &sampled);
    let measured = dql.step(golden.count("/step") as u64, &(batch, noise)).unwrap();
    check_update(golden, METRICS, &measured, dql.parts().save().unwrap());

    let temperature = golden.config["agent"]["temperature"].as_f64().unwrap() as f32;
    let candidates = golden.count("/agent/candidates") as u32;
    assert_eq!(
        choice,
        Choice { candidates, value: Aggregate::Min, rule: Rule::Softmax { temperature } }
    );
}

golden_tests!("dql", check);

/// The coin of Eq. 3 falls on either side, and the chains of next actions and of the actor's own
/// are not the same.
#[test]
fn the_noise_of_a_step_is_repeatable_and_each_critic_has_its_turn() {
    let dql = start(&goldens("dql").remove(0), &Device::Cpu);
    let numbers = |x: Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let [first, again] = [dql.noise(0).unwrap(), dql.noise(0).unwrap()];
    let next = numbers(first.next);
    assert!(
        next == numbers(again.next)
            && numbers(first.denoising.epsilon) == numbers(again.denoising.epsilon)
    );
    assert_ne!(next, numbers(first.policy));
    let raised = (0..1000)
        .filter(|step| dql.noise(*step).unwrap().raised.to_vec1::<u32>().unwrap()[0] == 1)
        .count();
    assert!((400..600).contains(&raised), "{raised}");
}
