//! Tests: an update against an independent implementation (tests/golden/README.md), and its phases.

use super::*;
use crate::golden::{
    Golden, batch, check_actions, check_update, context, golden_tests, goldens, load, table,
};
use candle_core::Device;

fn start(golden: &Golden, device: &Device) -> Cql {
    let mut cql = Cql::new(read(&table(golden)).unwrap(), context(golden, device)).unwrap();
    load(golden, cql.parts());
    cql
}

fn check(golden: &Golden, device: &Device) {
    let mut cql = start(golden, device);
    check_actions(golden, &cql);
    let input = |name| golden.input(name, device);
    let batch = batch(golden, &cql.context);
    let noise = Noise {
        policy: input("policy_noise").unsqueeze(1).unwrap(),
        target: input("target_noise"),
        uniform: input("uniform_actions"),
        next: input("next_noise"),
        current: input("current_noise"),
    };
    let current = cql.actor.constant_distribution(&batch.observations).unwrap();
    let next = cql.actor.constant_distribution(&batch.next_observations).unwrap();
    golden.close("policy_actions", &current.draw(&noise.policy).unwrap().actions);
    golden.close("targets", &cql.targets(&batch, &next, &noise.target).unwrap());
    golden.close("gaps", &cql.gaps(&batch, &current, &next, &noise).unwrap().1);
    let measured = cql.step(golden.count("/step") as u64, &batch, &noise).unwrap();
    check_update(golden, METRICS, &measured, cql.parts().save().unwrap());
}

golden_tests!("cql", check);

#[test]
fn a_run_of_any_length_is_divided_as_its_phases_are() {
    let of_mazes = Phases { cloning: 40_000, learning: Steps(1_160_000) };
    for (total_steps, expected) in [(1_200_000, 40_000), (600, 20), (1, 1)] {
        let cloning =
            (0..total_steps).take_while(|step| of_mazes.is_cloning(*step, total_steps)).count();
        assert_eq!(cloning, expected, "{total_steps}");
    }
    assert!(!Phases { cloning: 0, learning: Steps(1) }.is_cloning(0, 600));
}

/// young-geng's code clips them in the dataset, CORL's does not.
#[test]
fn a_run_that_clones_clips_the_datas_actions_for_the_critics_too() {
    for golden in goldens("cql") {
        let cql = start(&golden, &Device::Cpu);
        let batch = batch(&golden, &cql.context);
        let clipped =
            Minibatch { actions: batch.actions.clamp(-0.999, 0.999).unwrap(), ..batch.clone() };
        let noise = cql.noise(0).unwrap();
        let [next, current] = [&batch.next_observations, &batch.observations]
            .map(|s| cql.actor.constant_distribution(s).unwrap());
        let [as_recorded, clipped] = [batch, clipped].map(|batch| {
            let (q, _) = cql.gaps(&batch, &current, &next, &noise).unwrap();
            q.flatten_all().unwrap().to_vec1::<f32>().unwrap()
        });
        assert_eq!(
            as_recorded == clipped,
            cql.config.phases.cloning > 0,
            "{}",
            golden.folder.display()
        );
    }
}

/// Networks begin near 0 in value and mean, whatever their hidden layers begin with; random numbers
/// are a function of the step.
#[test]
fn a_run_begins_with_small_values_and_repeats_its_noise() {
    let golden = goldens("cql").remove(0);
    let cql = Cql::new(read(&table(&golden)).unwrap(), context(&golden, &Device::Cpu)).unwrap();
    let batch = batch(&golden, &cql.context);
    let largest = |x: Tensor| {
        x.abs().unwrap().flatten_all().unwrap().max(0).unwrap().to_scalar::<f32>().unwrap()
    };
    let q = cql.critics.network.values(&batch.observations, &batch.actions).unwrap();
    let policy = cql.actor.constant_distribution(&batch.observations).unwrap();
    assert!(
        largest(q) < 0.2
            && largest(policy.mean) < 0.2
            && largest((policy.log_std + 1.0).unwrap()) < 0.2
    );
    let numbers = |noise: Noise| {
        [noise.policy, noise.target, noise.uniform, noise.next, noise.current]
            .map(|x| x.flatten_all().unwrap().to_vec1::<f32>().unwrap())
    };
    let [first, again, other] = [0, 0, 1].map(|step| numbers(cql.noise(step).unwrap()));
    assert!(first == again && first != other && first[3] != first[4]);
}
