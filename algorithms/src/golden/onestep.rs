//! Tests: an update of each phase against an independent implementation (tests/golden/README.md),
//! and what it learns from.

use super::*;
use crate::golden::{
    Golden, batch, check_actions, check_update, context, golden_tests, goldens, load, table,
};
use candle_core::Device;
use quad_dataset::{Arrays, Transitions};
use std::sync::Arc;

fn start(golden: &Golden, device: &Device) -> Onestep {
    let mut onestep = Onestep::new(read(&table(golden)).unwrap(), context(golden, device)).unwrap();
    load(golden, onestep.parts());
    onestep
}

fn check(golden: &Golden, device: &Device) {
    let (mut onestep, step) = (start(golden, device), golden.count("/step") as u64);
    check_actions(golden, &onestep);
    let batch = batch(golden, &onestep.context);
    let measured = match onestep.phase(step) {
        Phase::Behavior(steps) => onestep.clone_behavior(&batch, steps),
        Phase::Critic(steps) => {
            onestep.evaluate_behavior(&batch, &golden.input("next_actions", device), steps)
        }
        Phase::Policy(steps) => {
            let noise = golden
                .input("behavior_noise", device)
                .transpose(0, 1)
                .unwrap()
                .contiguous()
                .unwrap();
            onestep.improve(&batch, &noise, steps)
        }
    };
    check_update(golden, METRICS, &measured.unwrap(), onestep.parts().save().unwrap());
}

golden_tests!("onestep", check);

/// Three episodes of two steps: the first terminates, the second is cut off, the third, of one step
/// more, continues to the end.
fn small_context(golden: &Golden) -> Context {
    let transitions = Transitions::of(Arrays {
        observation_dim: 1,
        action_dim: 1,
        observations: vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
        actions: vec![0.0, 0.1, 0.2, 0.3, 0.4, 0.5],
        rewards: vec![0.0; 6],
        next_observations: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
        terminals: vec![false, true, false, false, false, false],
        timeouts: vec![false, false, false, true, false, true],
    });
    Context {
        transitions: Arc::new(transitions.unwrap()),
        batch_size: 2,
        ..context(golden, &Device::Cpu)
    }
}

#[test]
fn it_learns_from_transitions_with_a_next_action_and_from_terminals() {
    let golden = goldens("onestep").remove(0);
    let onestep = Onestep::new(read(&table(&golden)).unwrap(), small_context(&golden)).unwrap();
    assert_eq!((onestep.items(6), &onestep.items[..]), (4, &[0, 1, 2, 4][..]));
    let next: Vec<Vec<f32>> =
        onestep.context.next_actions(&onestep.items).unwrap().to_vec2().unwrap();
    assert_eq!(next, [[0.1], [0.0], [0.3], [0.5]]);
}

/// Five steps: two for β, one for Q, and two for π.
fn short(golden: &Golden) -> Onestep {
    let mut config: Config = read(&table(golden)).unwrap();
    config.phases = Phases { behavior: Steps(4), critic: Steps(2), policy: Steps(4) };
    Onestep::new(config, Context { total_steps: 5, ..small_context(golden) }).unwrap()
}

/// A copy of its state, because weights are saved as views.
fn state(onestep: &mut Onestep) -> Tensors {
    let tensors = onestep.parts().save().unwrap().into_iter();
    tensors.map(|(name, tensor)| (name, tensor.copy().unwrap())).collect()
}

fn numbers(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

#[test]
fn a_dataset_of_single_transitions_is_refused_with_a_hint() {
    let golden = goldens("onestep").remove(0);
    // Its rows are at random, and none terminates.
    let mut context = context(&golden, &Device::Cpu);
    let arrays = Arrays {
        observation_dim: 1,
        action_dim: 1,
        observations: vec![0.0, 1.0],
        actions: vec![0.0, 0.1],
        rewards: vec![0.0; 2],
        next_observations: vec![1.0, 2.0],
        terminals: vec![false; 2],
        timeouts: vec![true; 2],
    };
    context.transitions = Arc::new(Transitions::of(arrays).unwrap());
    let refused = Onestep::new(read(&table(&golden)).unwrap(), context).err().unwrap();
    assert!(
        refused.to_string().contains("has a next action")
            && refused.hint().contains("datasets inspect"),
        "{refused}"
    );
}

#[test]
fn each_phase_trains_its_network_alone() {
    let golden = goldens("onestep").remove(0);
    let mut onestep = short(&golden);
    assert_eq!(onestep.phases(), [0, 2, 3]);
    let mut before = state(&mut onestep);
    for (step, moved) in
        ["behavior", "behavior", "critic", "actor", "actor"].into_iter().enumerate()
    {
        onestep.update(step as u64, &[0, 1]).unwrap();
        let after = state(&mut onestep);
        for (name, tensor) in &after {
            // The moments tell which network was trained: π moves with β.
            if let Some(of) = name.strip_prefix("adam_v.") {
                let changed = numbers(tensor) != numbers(&before[name]);
                assert!(!changed || of.starts_with(moved), "step {step}: {name}");
            }
        }
        let last = format!("{moved}.2.bias");
        assert!(numbers(&after[&last]) != numbers(&before[&last]), "step {step}: {moved} stays");
        let [actor, behavior] =
            ["actor.2.bias", "behavior.2.bias"].map(|name| numbers(&after[name]));
        let is_copy = actor.iter().zip(&behavior).all(|(x, y)| (x - y).abs() < 1e-6);
        assert_eq!(is_copy, step < 3, "step {step}");
        before = after;
    }
}
