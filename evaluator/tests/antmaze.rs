//! AntMaze: the mazes' geometry, what walls do to an ant, and the task's rules at their edges.
#![allow(clippy::unwrap_used)]

use mujoco_rs::wrappers::mj_data::MjData;
use mujoco_rs::wrappers::mj_model::MjModel;
use quad_dataset::environment::find;
use quad_evaluator::sim::{Simulation, Step, make, mjcf};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const MAZES: [&str; 3] = ["antmaze-umaze", "antmaze-medium", "antmaze-large"];
const AT_REST: [f64; 14] = [0.0; 14];

fn ant(name: &str) -> Simulation {
    make(find(name).unwrap(), 0).unwrap()
}

fn model(name: &str) -> MjModel {
    MjModel::from_xml_string(&mjcf(find(name).unwrap()).unwrap()).unwrap()
}

/// An ant on its feet at (x, y).
fn standing(x: f64, y: f64) -> [f64; 15] {
    [x, y, 0.55, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0]
}

#[test]
fn a_maze_is_its_map() {
    // Walls; rows and columns; the nominal goal; some free places.
    let mazes = [
        (18, [5, 5], [0.0, 8.0], vec![[4.0, 0.0], [8.0, 0.0], [8.0, 4.0], [8.0, 8.0], [4.0, 8.0]]),
        (38, [8, 8], [20.0, 20.0], vec![[4.0, 0.0], [20.0, 0.0], [0.0, 20.0], [12.0, 8.0]]),
        (62, [9, 12], [32.0, 24.0], vec![[8.0, 0.0], [36.0, 0.0], [0.0, 8.0], [16.0, 24.0], [36.0, 24.0]]),
    ];
    for (name, (count, [rows, columns], goal, free)) in MAZES.into_iter().zip(mazes) {
        let model = model(name);
        let walls: Vec<usize> =
            (0..model.geom_size().len()).filter(|&i| model.geom_size()[i] == [2.0, 2.0, 1.0]).collect();
        assert_eq!(walls.len(), count, "{name}");
        let mut blocked = vec![vec![false; columns]; rows];
        for &wall in &walls {
            let [x, y, z] = model.geom_pos()[wall];
            assert_eq!((z, x % 4.0, y % 4.0), (1.0, 0.0, 0.0), "{name}: a wall's centre");
            assert_eq!((model.geom_contype()[wall], model.geom_conaffinity()[wall]), (1, 1));
            blocked[(y / 4.0 + 1.0) as usize][(x / 4.0 + 1.0) as usize] = true;
        }
        assert_eq!(blocked.iter().flatten().filter(|&&wall| wall).count(), count, "{name}: one wall a cell");
        let is_edge = |i: usize, j: usize| i == 0 || j == 0 || i + 1 == rows || j + 1 == columns;
        assert!((0..rows).all(|i| (0..columns).all(|j| blocked[i][j] || !is_edge(i, j))), "{name} is closed");
        for [x, y] in free.into_iter().chain([[0.0, 0.0], goal]) {
            assert!(!blocked[(y / 4.0 + 1.0) as usize][(x / 4.0 + 1.0) as usize], "{name}: ({x}, {y})");
        }
        let mass: f64 = model.body_mass().iter().sum();
        assert!((mass - 0.9109).abs() < 5e-5, "{name}: {mass} kg");
    }
}

#[test]
fn initial_states_lie_around_the_start() {
    let rest = [0.0, 0.0, 0.75, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    for name in MAZES {
        let mut ant = ant(name);
        let (mut largest, mut squares) = (0.0_f64, 0.0);
        for seed in 0..200 {
            ant.reset(seed);
            let apart = ant.qpos().iter().zip(rest).map(|(value, rest)| (value - rest).abs());
            largest = apart.fold(largest, f64::max);
            squares += ant.qvel().iter().map(|value| value * value).sum::<f64>();
            assert_eq!(ant.observation(), [ant.qpos(), ant.qvel()].concat());
        }
        assert!(largest <= 0.1 && largest > 0.099, "{name}: {largest}");
        let deviation = (squares / (200.0 * 14.0)).sqrt();
        assert!((deviation - 0.1).abs() < 0.005, "{name}: {deviation}");
    }
}

#[test]
fn the_goal_is_reached_at_half_a_metre() {
    let mut ant = ant("antmaze-umaze");
    let mut step_with_goal = |goal: [f64; 2]| {
        ant.set_goal(&goal);
        ant.set_state(&standing(1.2, 0.0), &AT_REST);
        let step = ant.step(&[0.0; 8]);
        (step, [ant.qpos()[0], ant.qpos()[1]])
    };
    let (_, [x, y]) = step_with_goal([8.0, 8.0]);
    let edge = x + 0.5; // Exact: both lie between 1 and 2.
    assert_eq!(edge - x, 0.5);
    let reached = Step { reward: 1.0, terminated: true, truncated: false };
    let not_yet = Step { reward: 0.0, terminated: false, truncated: false };
    assert_eq!(step_with_goal([edge, y]).0, reached);
    assert_eq!(step_with_goal([edge.next_up(), y]).0, not_yet);
    assert_eq!(step_with_goal([x + 0.3, y - 0.39]).0, reached);
    assert_eq!(step_with_goal([x + 0.3, y - 0.41]).0, not_yet, "the distance is the Euclidean one");
}

#[test]
fn an_ant_does_not_pass_a_wall() {
    // Flung at 8 m/s along an axis: into a wall 2 m away, or along a corridor.
    let mut ant = ant("antmaze-umaze");
    let mut farthest = |axis: usize, velocity: f64| {
        let mut qvel = AT_REST;
        qvel[axis] = velocity;
        ant.set_state(&standing(0.0, 0.0), &qvel);
        let mut farthest = 0.0_f64;
        for _ in 0..20 {
            assert!(!ant.step(&[0.0; 8]).terminated);
            farthest = farthest.max(ant.qpos()[axis] * velocity.signum());
        }
        farthest
    };
    for (axis, velocity) in [(0, -8.0), (1, -8.0), (1, 8.0)] {
        let farthest = farthest(axis, velocity);
        assert!((0.3..2.0).contains(&farthest), "axis {axis}, {velocity} m/s: {farthest} m");
    }
    assert!(farthest(0, 8.0) > 3.0, "there is no wall that way");
}

#[test]
fn every_contact_is_between_the_ant_and_the_world() {
    let model = model("antmaze-umaze");
    let is_wall = |geom: i32| model.geom_size()[geom as usize] == [2.0, 2.0, 1.0];
    let body = |geom: i32| model.geom_bodyid()[geom as usize];
    let mut data = MjData::try_new(&model).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(0);
    let (mut with_walls, mut with_floor) = (0, 0);
    for _ in 0..300 {
        // Legs bent far beyond their limits, so that they cross, beside the wall at x = -2.
        let mut qpos = standing(-1.2, 0.0);
        qpos[7..].fill_with(|| random.random_range(-2.0..2.0));
        data.qpos_mut().copy_from_slice(&qpos);
        data.forward();
        for contact in data.contact() {
            let [one, other] = contact.geom;
            assert!((body(one) == 0) != (body(other) == 0), "body 0 is the world: floor and walls");
            if is_wall(one) || is_wall(other) { with_walls += 1 } else { with_floor += 1 }
        }
    }
    assert!(with_walls > 100 && with_floor > 100, "{with_walls} contacts with walls, {with_floor} with the floor");
}

#[test]
fn only_the_goal_and_the_time_limit_end_an_episode() {
    for (name, limit) in
        [("antmaze-umaze", 700), ("antmaze-umaze-v0", 700), ("antmaze-medium", 1000), ("antmaze-large-v0", 1000)]
    {
        let mut ant = ant(name);
        ant.reset(0);
        let mut on_its_back = standing(0.0, 0.0);
        on_its_back[3..7].copy_from_slice(&[0.0, 1.0, 0.0, 0.0]);
        ant.set_state(&on_its_back, &AT_REST);
        for step in 1..=limit {
            let expected = Step { reward: 0.0, terminated: false, truncated: step == limit };
            assert_eq!(ant.step(&[0.2; 8]), expected, "{name}, step {step}");
        }
    }
}

#[test]
fn actions_are_clipped() {
    let (mut one, mut other) = (ant("antmaze-umaze"), ant("antmaze-umaze"));
    one.reset(0);
    other.reset(0);
    assert_eq!(one.step(&[7.0; 8]), other.step(&[1.0; 8]));
    assert_eq!(one.observation(), other.observation());
    other.step(&[0.9; 8]);
    one.step(&[1.0; 8]);
    assert_ne!(one.observation(), other.observation());
}

#[test]
fn what_is_not_a_number_ends_the_episode_without_reward() {
    let end = Step { reward: 0.0, terminated: true, truncated: false };
    let mut ant = ant("antmaze-umaze");
    ant.reset(0);
    let beside = [ant.qpos()[0], ant.qpos()[1]];
    ant.set_goal(&beside);
    let mut action = [0.0; 8];
    action[5] = f32::NAN;
    assert_eq!(ant.step(&action), end, "even at the goal");
    let mut qvel = AT_REST;
    qvel[9] = 1e12;
    ant.set_state(&standing(0.0, 0.0), &qvel);
    assert_eq!(ant.step(&[0.0; 8]), end, "even at the goal");
    assert!(ant.observation().iter().all(|value| value.is_finite()));
    ant.reset(0);
    assert!(!ant.step(&[0.0; 8]).terminated, "a reset recovers");
}
