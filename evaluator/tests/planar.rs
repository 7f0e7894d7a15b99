//! What planar robots do at the edges: limits, clipping, numbers that are none.
#![allow(clippy::unwrap_used)]

use quad_dataset::environment::{all, find};
use quad_evaluator::sim::{Simulation, Step, make};

fn robots() -> impl Iterator<Item = &'static str> {
    all().iter().filter(|spec| spec.planar.is_some()).map(|spec| spec.name.as_str())
}

fn robot(name: &str) -> Simulation {
    make(find(name).unwrap(), 0).unwrap()
}

fn hopper() -> Simulation {
    robot("hopper")
}

/// A number of actions' worth of the same value.
fn actions(name: &str, value: f32) -> Vec<f32> {
    vec![value; find(name).unwrap().action_dim]
}

const STANDING: [f64; 6] = [0.0, 1.25, 0.0, 0.0, 0.0, 0.0];
const AT_REST: [f64; 6] = [0.0; 6];

#[test]
fn an_episode_is_a_function_of_its_seed() {
    for name in robots() {
        let (mut one, mut other) = (robot(name), robot(name));
        one.reset(7);
        one.step(&actions(name, 1.0));
        one.reset(8);
        other.reset(8);
        assert_eq!(one.observation(), other.observation());
        assert_eq!(one.step(&actions(name, 0.3)), other.step(&actions(name, 0.3)));
        assert_eq!(one.observation(), other.observation());
        other.reset(9);
        one.reset(8);
        assert_ne!(one.observation(), other.observation());
    }
}

/// The noise on the initial positions and velocities of 2,000 episodes.
fn initial_noise(name: &str) -> (Vec<f64>, Vec<f64>) {
    let mut robot = robot(name);
    let (mut positions, mut velocities) = (Vec::new(), Vec::new());
    let height = if name == "halfcheetah" { 0.0 } else { 1.25 };
    for seed in 0..2000 {
        robot.reset(seed);
        positions
            .extend(robot.qpos().iter().enumerate().map(|(i, value)| if i == 1 { value - height } else { *value }));
        velocities.extend_from_slice(robot.qvel());
    }
    (positions, velocities)
}

fn assert_fills(values: &[f64], bound: f64) {
    let (least, most) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), &v| (a.min(v), b.max(v)));
    assert!(least >= -bound && least < -0.99 * bound, "{least}");
    assert!(most <= bound && most > 0.99 * bound, "{most}");
}

#[test]
fn initial_states_lie_within_the_noise() {
    for name in ["hopper", "walker2d"] {
        let (positions, velocities) = initial_noise(name);
        assert_fills(&positions, 0.005);
        assert_fills(&velocities, 0.005);
    }
    let (positions, velocities) = initial_noise("halfcheetah");
    assert_fills(&positions, 0.1);
    let n = velocities.len() as f64;
    let mean = velocities.iter().sum::<f64>() / n;
    let deviation = (velocities.iter().map(|v| v * v).sum::<f64>() / n).sqrt();
    let within_one = velocities.iter().filter(|v| v.abs() < 0.1).count() as f64 / n;
    assert!(mean.abs() < 0.003 && (deviation - 0.1).abs() < 0.003, "mean {mean}, deviation {deviation}");
    assert!((within_one - 0.6827).abs() < 0.01, "{within_one}: a normal distribution has 0.6827");
}

#[test]
fn velocities_are_observed_within_ten_but_kept() {
    let mut hopper = hopper();
    hopper.set_state(&STANDING, &[0.0, 0.0, 25.0, -30.0, 0.0, 0.0]);
    assert_eq!(hopper.observation()[5..], [0.0, 0.0, 10.0, -10.0, 0.0, 0.0]);
    assert_eq!(hopper.qvel()[2..4], [25.0, -30.0]);
}

#[test]
fn only_halfcheetahs_velocities_are_observed_as_they_are() {
    for (name, seen) in [("halfcheetah", 25.0), ("walker2d", 10.0)] {
        let mut robot = robot(name);
        robot.set_state(&[0.0; 9], &[25.0; 9]);
        assert_eq!(robot.observation()[8..], [seen; 9]);
    }
}

#[test]
fn actions_are_clipped_before_they_cost() {
    let (mut one, mut other) = (hopper(), hopper());
    one.reset(0);
    other.reset(0);
    assert_eq!(one.step(&[5.0, -3.0, f32::INFINITY]), other.step(&[1.0, -1.0, 1.0]));
    assert_eq!(one.observation(), other.observation());
}

#[test]
fn the_bonus_is_paid_on_the_terminating_step_too() {
    let mut hopper = hopper();
    let mut lying = STANDING;
    lying[1] = 3.0; // In the air: nothing moves it along x.
    lying[2] = 0.5;
    hopper.set_state(&lying, &AT_REST);
    let step = hopper.step(&[0.0; 3]);
    assert!(step.terminated && !step.truncated);
    assert!((step.reward - 1.0).abs() < 1e-3, "{}", step.reward);
}

#[test]
fn a_hopper_is_healthy_within_its_bounds() {
    let mut hopper = hopper();
    // The legs lie level, so that no part of them is in the floor.
    for (z, pitch, velocity, terminated) in [
        (0.71, 0.0, 0.0, false),
        (0.69, 0.0, 0.0, true),
        (1.5, 0.19, 0.0, false),
        (1.5, -0.19, 0.0, false),
        (1.5, 0.21, 0.0, true),
        (1.5, -0.21, 0.0, true),
        (1.5, 0.0, 150.0, true),
    ] {
        let (mut qpos, mut qvel) = (AT_REST, AT_REST);
        (qpos[1], qpos[2], qpos[3]) = (z, pitch, -1.57);
        qvel[0] = velocity;
        hopper.set_state(&qpos, &qvel);
        assert_eq!(hopper.step(&[0.0; 3]).terminated, terminated, "z {z}, pitch {pitch}, {velocity} m/s");
    }
}

#[test]
fn a_walker_is_healthy_within_its_bounds() {
    let mut walker = robot("walker2d");
    for (z, pitch, terminated) in [
        (1.9, 0.0, false),
        (2.1, 0.0, true),
        (1.5, 0.95, false),
        (1.5, -0.95, false),
        (1.5, 1.05, true),
        (0.7, 0.0, true),
    ] {
        let mut qpos = [0.0; 9];
        (qpos[1], qpos[2]) = (z, pitch);
        walker.set_state(&qpos, &[0.0; 9]);
        assert_eq!(walker.step(&[0.0; 6]).terminated, terminated, "z {z}, pitch {pitch}");
    }
}

#[test]
fn a_cheetah_on_its_back_goes_on() {
    let mut cheetah = robot("halfcheetah");
    let mut qpos = [0.0; 9];
    qpos[2] = std::f64::consts::PI;
    cheetah.set_state(&qpos, &[0.0; 9]);
    for step in 1..=1000 {
        let Step { terminated, truncated, .. } = cheetah.step(&[0.5; 6]);
        assert!(!terminated, "step {step}");
        assert_eq!(truncated, step == 1000, "step {step}");
    }
}

#[test]
fn the_time_limit_truncates_and_does_not_terminate() {
    let mut hopper = hopper();
    hopper.reset(0);
    let mut airborne = STANDING;
    airborne[1] = 400.0; // Falls for longer than the time limit (8 s: 314 m), below the bound on velocities.
    hopper.set_state(&airborne, &AT_REST);
    for step in 1..=1000 {
        let Step { terminated, truncated, .. } = hopper.step(&[0.0; 3]);
        assert!(!terminated, "step {step}");
        assert_eq!(truncated, step == 1000, "step {step}");
    }
    hopper.reset(0);
    assert!(!hopper.step(&[0.0; 3]).truncated, "a reset starts the time anew");
}

#[test]
fn what_is_not_a_number_ends_the_episode_without_reward() {
    let end = Step { reward: 0.0, terminated: true, truncated: false };
    for name in robots() {
        let mut robot = robot(name);
        robot.reset(0);
        let mut action = actions(name, 0.0);
        action[1] = f32::NAN;
        assert_eq!(robot.step(&action), end);
        let (qpos, mut qvel) = (robot.qpos().to_vec(), robot.qvel().to_vec());
        qvel[3] = 1e12;
        robot.set_state(&qpos, &qvel);
        assert_eq!(robot.step(&actions(name, 0.0)), end);
        assert!(robot.observation().iter().all(|value| value.is_finite()));
        robot.reset(0);
        assert!(!robot.step(&actions(name, 0.0)).terminated, "a reset recovers");
    }
}
