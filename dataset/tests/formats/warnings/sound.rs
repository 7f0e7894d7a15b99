use quad_dataset::{environment, inspect};
use rand::Rng;

use super::{Cart, O, made, mass};
use crate::shared;

fn nothing_is_said(name: &str, cart: &Cart) {
    for own in [false, true] {
        assert_eq!(cart.warnings(own), [""; 0], "{name}, own: {own}");
    }
}

#[test]
fn a_cart_whose_state_is_kept_or_reset() {
    nothing_is_said("kept", &Cart::new(true));
    nothing_is_said("reset", &Cart::new(false));
}

#[test]
fn a_robot_at_a_high_rate() {
    nothing_is_said("a tenth of a second", &mass(60, 0.1));
    nothing_is_said("a millisecond", &mass(3000, 0.001));
}

#[test]
fn constant_velocity() {
    let cart = made(
        100,
        |random| [random.random_range(-1.0..1.0), 0.7, random.random_range(-1.0..1.0), -0.3],
        |random, [x, vx, y, vy]| {
            let next = [x + 0.01 * vx, vx, y + 0.01 * vy, vy];
            (
                [random.random_range(-1.0..1.0), random.random_range(-1.0..1.0)],
                next,
                -next[0].abs(),
                false,
            )
        },
    );
    nothing_is_said("constant velocity", &cart);
}

#[test]
fn rewards_at_the_goal_alone() {
    let mut cart = mass(60, 0.1);
    for (goal, others) in [(1.0, 0.0), (0.0, -1.0), (100.0, -1.0)] {
        let rewards = cart.terminals.iter().map(|terminal| if *terminal { goal } else { others });
        cart.rewards = rewards.collect();
        nothing_is_said("sparse", &cart);
    }
}

#[test]
fn episodes_of_one_step() {
    let context =
        |random: &mut rand_chacha::ChaCha8Rng| [0; O].map(|_| random.random_range(-1.0_f32..1.0));
    for stays in [false, true] {
        let mut cart = Cart::default();
        for seed in 0..20 {
            let one = made(
                1,
                |random| {
                    (0..seed).for_each(|_| {
                        context(random);
                    });
                    context(random)
                },
                |random, state| {
                    let action = [random.random_range(-1.0..1.0), random.random_range(-1.0..1.0)];
                    (
                        action,
                        if stays { state } else { context(random) },
                        action[0] * state[0],
                        true,
                    )
                },
            );
            cart.observations.extend(one.observations);
            cart.next_observations.extend(one.next_observations);
            cart.actions.extend(one.actions);
            cart.rewards.extend(one.rewards);
            cart.terminals.extend(one.terminals);
            cart.timeouts.extend(one.timeouts);
        }
        nothing_is_said("one step", &cart);
    }
}

#[test]
fn recordings_and_files_of_others() {
    for (file, spec) in [
        ("data/hopper_medium_replay.hdf5", "hopper"),
        ("data/halfcheetah_medium_replay.hdf5", "halfcheetah"),
        ("data/walker2d_medium_replay.hdf5", "walker2d"),
        ("data/antmaze_umaze_direct.hdf5", "antmaze-umaze"),
        ("data/antmaze_medium_play.hdf5", "antmaze-medium"),
        ("fixtures/hopper_fixture-v2.hdf5", "hopper"),
        ("cases/sound.hdf5", ""),
        ("cases/sound-d4rl.hdf5", ""),
        ("cases/half-precision.hdf5", ""),
    ] {
        let Some(path) = shared(file) else { continue };
        for spec in [environment::find(spec).ok(), None] {
            assert_eq!(inspect(&path, spec).unwrap().problems, [""; 0], "{file}");
        }
    }
}

#[test]
fn files_with_one_fault_each() {
    for (file, expected) in [
        ("discount-as-done", &["array `terminals`: says in 98.099 % of the rows"][..]),
        ("frozen-observations", &["array `observations`: does not change in 9"]),
        ("constant-columns", &["array `actions`, row 0: the action -11.667108 is outside"]),
        (
            "degrees-newtons",
            &[
                "array `rewards`: of size 221.4",
                "array `observations`: far from ±1 in columns 2, 3",
            ],
        ),
        ("rewards-all-one", &["array `rewards`: all are alike"]),
        ("timeouts-one-row-late", &["array `timeouts`: one row late"]),
        ("one-observation-near-a-million", &["array `observations`: far from ±1 in column 4"]),
    ] {
        let Some(path) = shared(&format!("cases/{file}.hdf5")) else { continue };
        let problems = inspect(&path, None).unwrap().problems;
        assert_eq!(problems.len(), expected.len(), "{file}: {problems:?}");
        for (problem, expected) in problems.iter().zip(expected) {
            assert!(problem.starts_with(expected), "{file}: {problem}");
        }
    }
}
