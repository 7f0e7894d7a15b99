//! Behavior of simulations beyond the comparison with Gymnasium: initial states, rare bounds, time
//! limits, and values that are not finite.

use quad_dataset::environment::{EnvironmentSpec, find, specs};
use quad_evaluator::sim::{Simulation, Step, make};

fn simulation(name: &str) -> Simulation {
    make(find(name).unwrap(), 0).unwrap()
}

#[test]
fn an_episode_is_a_function_of_its_seed() {
    for spec in specs() {
        let (mut one, mut other) = (make(spec, 0).unwrap(), make(spec, 0).unwrap());
        let sizes = [one.observation(), one.qpos(), one.qvel()].map(<[f64]>::len);
        assert_eq!(sizes, [spec.observation_dim, spec.qpos_dim, spec.qvel_dim], "{}", spec.name);
        let action = vec![0.3; spec.action_dim];
        one.reset(7);
        one.step(&action);
        one.reset(8);
        other.reset(8);
        for _ in 0..10 {
            assert_eq!(one.observation(), other.observation(), "{}", spec.name);
            assert_eq!(one.step(&action), other.step(&action), "{}", spec.name);
        }
        one.reset(9);
        other.reset(8);
        assert_ne!(one.observation(), other.observation(), "{}", spec.name);
    }
}

/// The noise on the positions and velocities of 2,000 initial states around `rest`.
fn initial_noise(name: &str, rest: &[f64]) -> [Vec<f64>; 2] {
    let mut simulation = simulation(name);
    let (mut positions, mut velocities) = (Vec::new(), Vec::new());
    for seed in 0..2000 {
        simulation.reset(seed);
        let moved = simulation.qpos().iter().zip(rest);
        positions.extend(moved.map(|(value, rest)| value - rest));
        velocities.extend_from_slice(simulation.qvel());
    }
    [positions, velocities]
}

/// Asserts that values lie within ± `bound` and come near to both ends.
fn assert_fills(values: &[f64], bound: f64) {
    for sign in [-1.0, 1.0] {
        let end = values.iter().map(|value| sign * value).fold(0.0, f64::max);
        // Sums with the position at rest are rounded.
        assert!(end <= bound + 1e-12 && end > 0.99 * bound, "{end}");
    }
}

#[test]
fn initial_states_lie_within_the_noise() {
    let (mut standing, mut ant) = ([0.0; 15], [0.0; 15]);
    (standing[1], ant[2], ant[3]) = (1.25, 0.75, 1.0);
    for name in ["hopper", "walker2d"] {
        initial_noise(name, &standing).iter().for_each(|values| assert_fills(values, 0.005));
    }
    for (name, rest) in [("halfcheetah", [0.0; 15]), ("antmaze-large", ant)] {
        let [positions, velocities] = initial_noise(name, &rest);
        assert_fills(&positions, 0.1);
        // Of a normal distribution with deviation 0.1, 68.27 % lie within it.
        let mean_of = |value: fn(f64) -> f64| {
            velocities.iter().map(|v| value(*v)).sum::<f64>() / velocities.len() as f64
        };
        let within_one = mean_of(|v| f64::from(u8::from(v.abs() < 0.1)));
        assert!(mean_of(|v| v).abs() < 0.003, "{name}");
        assert!((mean_of(|v| v * v).sqrt() - 0.1).abs() < 0.003, "{name}");
        assert!((within_one - 0.6827).abs() < 0.01, "{name}: {within_one}");
    }
}

#[test]
fn a_hopper_is_healthy_only_below_a_hundred_meters_a_second() {
    let mut hopper = simulation("hopper");
    for (velocity, terminated) in [(90.0, false), (110.0, true)] {
        // In the air, with level legs.
        let qpos = [0.0, 1.5, 0.0, -1.57, 0.0, 0.0];
        hopper.set_state(&qpos, &[velocity, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let step = hopper.step(&[0.0; 3]);
        assert_eq!(step.terminated, terminated, "{velocity} m/s");
    }
}

#[test]
fn infinite_actions_are_clipped() {
    let (mut one, mut other) = (simulation("hopper"), simulation("hopper"));
    one.reset(0);
    other.reset(0);
    let mut step = one.step(&[5.0, f32::NEG_INFINITY, f32::INFINITY]);
    assert_eq!(step.clipped.take(), Some(vec![1.0, -1.0, 1.0]));
    assert_eq!(step, other.step(&[1.0, -1.0, 1.0]));
    assert_eq!(one.observation(), other.observation());
}

#[test]
fn a_goal_is_reached_at_half_a_meter() {
    let mut ant = simulation("antmaze-umaze");
    let standing = [1.2, 0.0, 0.55, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0];
    let mut step_with_goal = |goal: [f64; 2]| {
        ant.set_goal(&goal);
        ant.set_state(&standing, &[0.0; 14]);
        let step = ant.step(&[0.0; 8]);
        let place = [ant.qpos()[0], ant.qpos()[1]];
        (place, step.reward, step.terminated)
    };
    let ([x, y], ..) = step_with_goal([8.0, 8.0]);
    let edge = x + 0.5; // Exact: both lie between 1 and 2.
    assert_eq!(edge - x, 0.5);
    assert_eq!(step_with_goal([edge, y]), ([x, y], 1.0, true));
    let outside = step_with_goal([edge.next_up(), y]);
    assert_eq!(outside, ([x, y], 0.0, false));
}

/// Positions in which nothing but the time limit ends an episode: in the air, or on the back. A
/// walker has none.
fn endless(spec: &EnvironmentSpec) -> Option<Vec<f64>> {
    let mut qpos = vec![0.0; spec.qpos_dim];
    match (spec.simulation(), spec.qpos_dim) {
        ("walker2d" | "walker2d-v5", _) => return None,
        ("hopper", _) => qpos[1] = 400.0, // Falls for 8 s, 314 m, at less than 100 m/s.
        ("halfcheetah", _) => qpos[2] = std::f64::consts::PI,
        (_ball, 2) => {}
        (_ant, _) => qpos[2..5].copy_from_slice(&[0.55, 0.0, 1.0]),
    }
    Some(qpos)
}

#[test]
fn the_time_limit_truncates_and_does_not_terminate() {
    // The tasks of one simulation differ in start and goal alone.
    for spec in specs().iter().filter(|spec| spec.name == spec.simulation()) {
        let Some(qpos) = endless(spec) else { continue };
        let (mut simulation, still) = (make(spec, 0).unwrap(), vec![0.0; spec.action_dim]);
        simulation.reset(0);
        simulation.set_state(&qpos, &vec![0.0; spec.qvel_dim]);
        for i in 1..=spec.max_episode_steps {
            let step = simulation.step(&still);
            assert!(!step.terminated, "{}, {i}", spec.name);
            let is_last = i == spec.max_episode_steps;
            assert_eq!(step.truncated, is_last, "{}, {i}", spec.name);
        }
        simulation.reset(0);
        assert!(!simulation.step(&still).truncated, "a reset restarts the time");
    }
}

#[test]
fn values_that_are_not_finite_end_the_episode_without_reward() {
    let end = |step: Step| (step.reward, step.terminated, step.truncated) == (0.0, true, false);
    for spec in specs() {
        let mut simulation = make(spec, 0).unwrap();
        simulation.reset(0);
        // Even at the goal.
        let here = [simulation.qpos()[0], simulation.qpos()[1]];
        simulation.set_goal(&here);
        let still = vec![0.0; spec.action_dim];
        let mut action = still.clone();
        action[1] = f32::NAN;
        assert!(end(simulation.step(&action)), "{}", spec.name);
        let (qpos, mut qvel) = (simulation.qpos().to_vec(), simulation.qvel().to_vec());
        // A ball, which has two velocities, stops at every step.
        if let Some(velocity) = qvel.get_mut(3) {
            *velocity = 1e12;
            simulation.set_state(&qpos, &qvel);
            assert!(end(simulation.step(&still)), "{}", spec.name);
            let mut observation = simulation.observation().iter();
            assert!(observation.all(|value| value.is_finite()));
        }
        simulation.set_goal(&[50.0; 2]);
        simulation.reset(0);
        assert!(!simulation.step(&still).terminated, "a reset recovers");
    }
}
