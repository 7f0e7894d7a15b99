//! Tests: an update and plans against an independent implementation (tests/golden/README.md), and
//! what is learned from.

use super::*;
use crate::golden::{Golden, check_update, golden_tests, load, table};
use candle_core::Device;
use quad_dataset::{Arrays, Transitions};
use quad_nn::{Precision, Scaling};
use quad_policy::{Planner, read_tensors};
use std::sync::Arc;

/// Episodes of so many transitions, numbered through; every second terminates.
fn transitions(dims: (usize, usize), lengths: &[usize]) -> Transitions {
    let n = lengths.iter().sum();
    let numbers = |width: usize, from: f32| {
        (0..n * width).map(|i| ((i / width) as f32 + from) / 100.0).collect()
    };
    let ends: Vec<usize> = lengths
        .iter()
        .scan(0, |end, length| Some(*end + length).inspect(|sum| *end = *sum))
        .collect();
    let ends_of =
        |odd: usize| -> Vec<usize> { ends.iter().copied().skip(odd).step_by(2).collect() };
    let flags = |ends: Vec<usize>| (1..=n).map(|count| ends.contains(&count)).collect();
    Transitions::of(Arrays {
        observation_dim: dims.0,
        action_dim: dims.1,
        observations: numbers(dims.0, 0.0),
        actions: numbers(dims.1, 0.0),
        rewards: numbers(1, 0.0),
        next_observations: numbers(dims.0, 1.0),
        terminals: flags(ends_of(1)),
        timeouts: flags(ends_of(0)),
    })
    .unwrap()
}

fn context(dims: (usize, usize), lengths: &[usize], batch_size: usize, device: &Device) -> Context {
    Context {
        transitions: Arc::new(transitions(dims, lengths)),
        batch_size,
        total_steps: 2000,
        seed: 0,
        precision: Precision::F32,
        device: device.clone(),
    }
}

fn start(golden: &Golden, device: &Device) -> Diffuser {
    let dims = (golden.count("/observation_dim"), golden.count("/action_dim"));
    let horizon = golden.count("/agent/network/horizon");
    let context = context(dims, &[2 * horizon], golden.count("/batch_size"), device);
    let mut diffuser = Diffuser::new(read(&table(golden)).unwrap(), context).unwrap();
    load(golden, diffuser.parts());
    diffuser
}

/// What the published networks plan with a folder's states and noise.
fn check_plans(golden: &Golden, diffuser: &Diffuser) {
    let (policy, tensors) = diffuser.policy().unwrap();
    let file = quad_policy::Header::new(policy.clone(), ());
    let mut tensors = read_tensors(&file.to_safetensors(&tensors).unwrap()).unwrap();
    let PolicyConfig::Diffuser { shape, choice } = policy else { panic!("{policy:?}") };
    assert_eq!(choice, Choice::best_of(golden.count("/agent/candidates") as u32));
    let mut weights =
        |layout: Layout, prefix: &str| Weights::take(layout, &mut tensors, prefix).unwrap();
    let (network, width) = (shape.network.clone(), shape.width());
    let model = TrajectoryModel::new(
        network.clone(),
        weights(TrajectoryModel::layout(&network, width), "model."),
    );
    let value = TrajectoryValue::new(
        network.clone(),
        weights(TrajectoryValue::layout(&network, width), "value."),
    );
    let planning = Planner::new(DiffuserShape { units: Scaling::default(), ..shape }, model, value);
    let numbers =
        |name| golden.input(name, &Device::Cpu).flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let (actions, values) =
        planning.plan(&numbers("select_observations"), &numbers("select_noise")).unwrap();
    let tensor = |x: Vec<f32>| Tensor::new(x, &Device::Cpu).unwrap();
    let (plans, a) = (golden.count("/agent/candidates"), golden.count("/action_dim"));
    let taken = golden.count("/agent/replan_every") * a;
    let best = |values: &[f32]| {
        (0..plans).fold(0, |best, i| if values[i] > values[best] { i } else { best })
    };
    let chosen: Vec<usize> = values.chunks_exact(plans).map(best).collect();
    let of_state =
        |(i, chosen): (usize, &usize)| actions[(i * plans + chosen) * taken..][..a].to_vec();
    golden.close("select.actions", &tensor(chosen.iter().enumerate().flat_map(of_state).collect()));
    golden.close("select.index", &tensor(chosen.iter().map(|chosen| *chosen as f32).collect()));
    golden.close("select.candidates", &tensor(actions));
    golden.close("select.values", &tensor(values));
}

fn check(golden: &Golden, device: &Device) {
    let mut diffuser = start(golden, device);
    check_plans(golden, &diffuser);
    let batch = Batch {
        windows: golden.input("windows", device),
        returns: golden.input("returns", device),
    };
    let t: Vec<i64> = golden.inputs["t"].to_vec1().unwrap();
    let noise = Noise {
        t: t.into_iter().map(|t| t as u32).collect(),
        epsilon: golden.input("epsilon", device),
    };
    golden.close("noisy_windows", &diffuser.noisy(&batch.windows, &noise).unwrap());
    let measured = diffuser.step(golden.count("/step") as u64, &batch, &noise).unwrap();
    check_update(golden, METRICS, &measured, diffuser.parts().save().unwrap());
}

golden_tests!("diffuser", check);

/// An episode of three transitions that is cut off, one of two that terminates, one of two that is
/// cut off.
#[test]
fn windows_run_past_the_end_of_episodes_that_terminate() {
    let context = context((1, 1), &[3, 2, 2], 1, &Device::Cpu);
    let windows = Windows::new(&context, 3, 0.5, 100.0).unwrap();
    assert_eq!(windows.count(), 3, "a whole one, and both of the episode that terminates");
    let batch = windows.batch(&[0, 1, 2], &Device::Cpu).unwrap();
    // Rewards are the transitions' numbers in hundredths.
    let returns: Vec<f32> = batch.returns.to_vec1().unwrap();
    let expected = [0.0 + 0.005 + 0.005, 0.03 + 0.5 * (0.04 - 100.0), 0.04 - 100.0];
    assert!(
        returns.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-5),
        "{returns:?}"
    );
    // Numbers 0 to 6 in hundredths: mean 0.03, deviation 0.02; no transition is 0 there, in units
    // of deviations −1.5.
    let numbers: Vec<Vec<Vec<f32>>> = batch.windows.to_vec3().unwrap();
    let rows = [[-1.5, -1.0, -0.5], [0.0, 0.5, -1.5], [0.5, -1.5, -1.5]];
    for (found, expected) in numbers.iter().zip(rows) {
        for (found, expected) in found.iter().zip(expected) {
            assert!(found.iter().all(|x| (x - expected).abs() < 1e-5), "{numbers:?}");
        }
    }
}

#[test]
fn a_dataset_without_a_window_is_refused_with_a_hint() {
    let refused = Windows::new(&context((1, 1), &[3], 1, &Device::Cpu), 4, 0.5, 0.0).err().unwrap();
    assert!(
        refused.to_string().contains("has 4 transitions") && refused.hint().contains("horizon"),
        "{refused}"
    );
}
