//! What Hopper does at the edges: limits, clipping, numbers that are none.
#![allow(clippy::unwrap_used)]

use quad_dataset::environment::find;
use quad_evaluator::environment::{Environment, Step, make};

fn hopper() -> Box<dyn Environment> {
    make(find("hopper").unwrap(), 0).unwrap()
}

const STANDING: [f64; 6] = [0.0, 1.25, 0.0, 0.0, 0.0, 0.0];
const AT_REST: [f64; 6] = [0.0; 6];

#[test]
fn an_episode_is_a_function_of_its_seed() {
    let (mut one, mut other) = (hopper(), hopper());
    one.reset(7);
    one.step(&[1.0, -1.0, 0.5]);
    one.reset(8);
    other.reset(8);
    assert_eq!(one.observation(), other.observation());
    assert_eq!(one.step(&[0.3, 0.2, 0.1]), other.step(&[0.3, 0.2, 0.1]));
    assert_eq!(one.observation(), other.observation());
    other.reset(9);
    one.reset(8);
    assert_ne!(one.observation(), other.observation());
}

#[test]
fn initial_states_lie_within_the_noise() {
    let mut hopper = hopper();
    let (mut least, mut most) = (f64::INFINITY, f64::NEG_INFINITY);
    for seed in 0..200 {
        hopper.reset(seed);
        for (value, centre) in hopper.qpos().iter().chain(hopper.qvel()).zip(STANDING.iter().chain(&AT_REST)) {
            least = least.min(value - centre);
            most = most.max(value - centre);
        }
    }
    assert!((-0.005..-0.0049).contains(&least), "{least}");
    assert!(most <= 0.005 && most > 0.0049, "{most}");
}

#[test]
fn velocities_are_observed_within_ten_but_kept() {
    let mut hopper = hopper();
    hopper.set_state(&STANDING, &[0.0, 0.0, 25.0, -30.0, 0.0, 0.0]);
    assert_eq!(hopper.observation()[5..], [0.0, 0.0, 10.0, -10.0, 0.0, 0.0]);
    assert_eq!(hopper.qvel()[2..4], [25.0, -30.0]);
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
    let mut hopper = hopper();
    hopper.reset(0);
    assert_eq!(hopper.step(&[0.0, f32::NAN, 0.0]), end);
    hopper.set_state(&STANDING, &[0.0, 0.0, 0.0, 1e12, 0.0, 0.0]);
    assert_eq!(hopper.step(&[0.0; 3]), end);
    assert!(hopper.observation().iter().all(|value| value.is_finite()));
    hopper.reset(0);
    assert!(!hopper.step(&[0.0; 3]).terminated, "a reset recovers");
}
