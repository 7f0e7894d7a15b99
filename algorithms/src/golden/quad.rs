//! Tests: the update against an independent implementation (tests/golden/README.md).

use super::*;
use crate::algorithm::Algorithm;
use crate::golden::{
    Golden, batch, chain_noise, check_update, context, denoising, golden_tests, goldens, load, run,
    table, value,
};
use crate::hyperparameters::{NotNegative, Positive};
use candle_core::{DType, Device};

fn start(golden: &Golden, device: &Device) -> Diffusion<Quad> {
    let mut quad = Config::read(&table(golden)).unwrap().start(context(golden, device)).unwrap();
    load(golden, quad.parts());
    // Below 0: not set yet.
    let is_set = |nu_squared: &Tensor| nu_squared.to_scalar::<f32>().unwrap() >= 0.0;
    quad.update.nu_squared = quad.update.nu_squared.filter(is_set);
    quad
}

fn noise(golden: &Golden, device: &Device) -> Noise {
    let permutation = golden.inputs.get("permutation");
    let permutation =
        permutation.map(|rows| rows.to_dtype(DType::U32).unwrap().to_device(device).unwrap());
    Noise {
        next: chain_noise(golden, "next_noise", device),
        denoising: denoising(golden, device),
        permutation,
    }
}

fn check(golden: &Golden, device: &Device) {
    let mut quad = start(golden, device);
    let inputs = (batch(golden, &quad.networks.context), noise(golden, device));
    let eta: f32 = quad.update.eta.to_scalar().unwrap();
    let measured = quad.step(golden.count("/step") as u64, &inputs).unwrap();
    check_update(golden, METRICS, &measured, quad.parts().save().unwrap());
    let value = |name| value(&measured, name).unwrap();
    let guidance_loss = value("actor_loss") - eta * value("bc_loss");
    // A difference of two larger numbers, so relative to these.
    let expected = golden.expected["guidance_loss"].to_vec1::<f32>().unwrap()[0];
    let size = value("actor_loss").abs().max(eta * value("bc_loss"));
    assert!((guidance_loss - expected).abs() < 1e-4 * size, "{guidance_loss} for {expected}");
}

golden_tests!("quad", check);

/// Whatever the algorithm holds beside them: what is published are the EMAs of actor and critics.
#[test]
fn the_policy_is_of_the_target_networks() {
    for golden in goldens("quad") {
        let (_, policy) = start(&golden, &Device::Cpu).policy().unwrap();
        let networks = ["actor.", "critic."]
            .map(|network| policy.keys().any(|name| name.starts_with(network)));
        assert_eq!(networks, [true, true]);
        for (name, tensor) in policy {
            let [found, expected] = [&tensor, &golden.state[&format!("target_{name}")]]
                .map(|tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap());
            assert_eq!(found, expected, "{name}");
        }
    }
}

/// Line 12 of Algorithm 1: dual ascent by at most `eta.rate`, within the bounds.
#[test]
fn eta_moves_by_at_most_its_rate_and_stays_within_its_bounds() {
    let golden = goldens("quad")
        .into_iter()
        .find(|golden| golden.config["agent"]["guidance"] == "quad")
        .unwrap();
    // ε ten times as large makes a BC loss near 100, which is far above or far below the threshold.
    let moved = |threshold: f32, minimum: f32, maximum: f32| {
        let (batch, mut noise) =
            (batch(&golden, &context(&golden, &Device::Cpu)), noise(&golden, &Device::Cpu));
        noise.denoising.epsilon = (noise.denoising.epsilon * 10.0).unwrap();
        let mut quad = start(&golden, &Device::Cpu);
        quad.update.config.eta = Eta {
            initial: NotNegative(1.0),
            threshold: Some(Positive(threshold)),
            rate: NotNegative(0.25),
            minimum: NotNegative(minimum),
            maximum: NotNegative(maximum),
        };
        quad.update.eta = Tensor::new(1f32, &Device::Cpu).unwrap();
        quad.step(0, &(batch, noise)).unwrap();
        quad.update.eta.to_scalar::<f32>().unwrap()
    };
    assert_eq!((moved(0.1, 0.0, 9.0), moved(1e4, 0.0, 9.0)), (1.25, 0.75));
    assert_eq!((moved(0.1, 0.0, 1.125), moved(1e4, 0.875, 9.0)), (1.125, 0.875));
}

#[test]
fn the_noise_of_a_step_is_repeatable_and_no_other_steps() {
    let golden = goldens("quad").remove(0);
    let quad = start(&golden, &Device::Cpu);
    let numbers = |step: u64| {
        let Noise { next, denoising: Denoising { t, epsilon, .. }, .. } = quad.noise(step).unwrap();
        let [next, epsilon] =
            [next, epsilon].map(|x| x.flatten_all().unwrap().to_vec1::<f32>().unwrap());
        (next, t.to_vec1::<u32>().unwrap(), epsilon)
    };
    assert_eq!(numbers(0), numbers(0));
    let (next, t, epsilon) = numbers(0);
    let other = numbers(1);
    assert!(next != other.0 && t != other.1 && epsilon != other.2);
}

#[test]
fn every_denoising_step_is_drawn_equally_often() {
    let golden = goldens("quad").remove(0);
    let quad = start(&golden, &Device::Cpu);
    let mut counts = vec![0; quad.networks.shape.diffusion_steps];
    let drawn =
        (0..1000).flat_map(|step| quad.noise(step).unwrap().denoising.t.to_vec1::<u32>().unwrap());
    drawn.for_each(|t| counts[t as usize - 1] += 1);
    let expected = 1000 * quad.networks.context.batch_size / counts.len();
    // Six standard deviations of a binomial count.
    let room = 6.0 * (expected as f64).sqrt();
    assert!(
        counts.iter().all(|count| (f64::from(*count) - expected as f64).abs() < room),
        "{counts:?}"
    );
}

#[test]
fn golden_parts() {
    for golden in goldens("quad") {
        let device = Device::Cpu;
        let Diffusion { update, mut networks, .. } = start(&golden, &device);
        let (batch, noise) = (batch(&golden, &networks.context), noise(&golden, &device));
        let next = networks.target_actor.sample(&batch.next_observations, &noise.next).unwrap();
        golden.close("next_actions", &next);
        golden.close("targets", &update.targets(&networks, &batch, &noise.next).unwrap());
        if update.config.guidance == Guidance::None {
            continue;
        }
        // Guidance comes from the target critics as the update has just moved them.
        networks
            .target_critics
            .weights_mut()
            .load(&mut golden.expected.clone(), "target_critic.")
            .unwrap();
        let (noisy, predicted) = networks.denoise(&batch, &noise.denoising).unwrap();
        golden.close("noisy_actions", &noisy);
        let gradients =
            networks.target_critics.action_gradients(&batch.observations, &noisy).unwrap();
        golden.close("critic_action_gradients", &gradients);
        let predicted = predicted.detach();
        let guide = update.guide(&networks, &batch, &noisy, &predicted, &noise).unwrap();
        let mean = gradients.mean(0).unwrap().broadcast_div(&golden.expected["q_scale"]).unwrap();
        let difference = (&guide.gradient - &mean)
            .unwrap()
            .abs()
            .unwrap()
            .max_all()
            .unwrap()
            .to_scalar::<f32>()
            .unwrap();
        assert!(
            difference < 1e-4 * mean.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap()
        );
        golden.close("nu_squared", &guide.nu_squared);
        golden.close("sigma_squared", &guide.sigma_squared);
        golden.close("lambda", &guide.lambda);
    }
}

#[test]
fn a_shuffle_moves_samples_among_those_of_their_denoising_step() {
    let golden = goldens("quad")
        .into_iter()
        .find(|golden| golden.config["agent"]["guidance"] == "shuffled")
        .unwrap();
    let mut quad = start(&golden, &Device::Cpu);
    quad.networks.context.batch_size = 500;
    let Noise { denoising: Denoising { t, .. }, permutation, .. } = quad.noise(0).unwrap();
    let t: Vec<u32> = t.to_vec1().unwrap();
    let mut rows: Vec<u32> = permutation.unwrap().to_vec1().unwrap();
    assert!(rows.iter().zip(&t).all(|(row, step)| t[*row as usize] == *step));
    // Of n things in random order one stays on average; of three t's three do.
    assert!(rows.iter().enumerate().filter(|(place, row)| *place == **row as usize).count() < 20);
    rows.sort_unstable();
    assert_eq!(rows, Vec::from_iter(0..500));
}

#[test]
fn an_infinite_temperature_is_dac() {
    let golden = goldens("quad")
        .into_iter()
        .find(|golden| golden.config["agent"]["guidance"] == "quad")
        .unwrap();
    let [quad, dac] = [Guidance::Quad, Guidance::Dac].map(|guidance| {
        let mut quad = start(&golden, &Device::Cpu);
        let config = &mut quad.update.config;
        (config.guidance, config.tau, config.delta) = (guidance, f32::INFINITY, Positive(1e-30));
        let (batch, noise) =
            (batch(&golden, &context(&golden, &Device::Cpu)), noise(&golden, &Device::Cpu));
        quad.step(0, &(batch, noise)).unwrap()
    });
    assert_eq!(quad, dac);
}

/// What `deploy/bench.sh` sets the learner beside does the work that the learner does.
#[test]
fn golden_peer_of_the_benchmarks() {
    run("algorithms/benches/jax_step.py", &["--check"]);
}
