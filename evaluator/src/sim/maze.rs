//! Mazes: a robot comes through a maze to a goal that it does not observe.
//!
//! Positions are in meters and radians, velocities per second. The table of benchmarks
//! (`dataset/benchmarks.toml`) has a benchmark's robots, mazes and rules; the world's origin is the
//! center of the cell (1, 1).
//!
//! The ant is D4RL's:
//! - qpos (15): the torso's x, y, z and quaternion (w first), then hip and ankle of legs 1 to 4;
//!   qvel (14): the torso's linear and angular velocities, then the joints'.
//! - Observation (29): qpos and qvel. The goal is not part of it.
//! - Action (8): torques of hip and ankle of legs 4, 1, 2 and 3, as fractions of 30 Nm, clipped to
//!   ±1; held for 0.1 s.
//!
//! OGBench's point is a ball that observes x and y. An action (2) displaces it at once, by
//! fractions of 0.2 m on each axis, without any velocity; then walls push it back for 0.1 s.
//!
//! The reward of a step that reaches the goal is 1, of every other 0. Only the goal and the time
//! limit end an episode: an ant on its back continues. A goal that is drawn lies, on each axis, at
//! max(0, the center of its cell + U(0, 1) + U(0, 0.5)). Where a step is judged by the state before
//! it, an episode ends one step after the robot reached the goal.

use quad_dataset::{CELL, EnvironmentSpec, GoalDraw, Judged, MazeTask, Robot};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::simulation::{RobotSpec, Simulation, Task};

/// Random stream of a goal, of an episode's or an environment's seed.
const GOAL_STREAM: u64 = 4;
/// Random stream of a start.
const START_STREAM: u64 = 5;
/// Placeholder of the walls in a robot's model.
const WALLS: &str = "<!-- walls -->";

/// The robot observes all positions, then as many velocities as the observation has room for.
pub(super) fn robot(robot: &Robot) -> RobotSpec {
    RobotSpec {
        frame_skip: robot.frame_skip,
        drive: robot.drive,
        noise: robot.noise,
        hidden_positions: 0,
        observed_velocity: f64::INFINITY,
    }
}

/// The model of a robot and its floor, with a box for each wall of a maze, half a cell high.
pub(super) fn mjcf(robot: &str, map: &[String]) -> String {
    let mut walls = String::new();
    for (i, row) in map.iter().enumerate() {
        for (j, _) in row.bytes().enumerate().filter(|(_, cell)| *cell == b'1') {
            let [x, y] = [j, i].map(|cell| (cell as f64 - 1.0) * CELL);
            walls += &format!("<geom class=\"wall\" pos=\"{x} {y} 1\"/>\n    ");
        }
    }
    robot.replacen(WALLS, walls.trim_end(), 1)
}

/// A task in a maze, and the goal of the current episode.
pub(super) struct Navigation {
    task: MazeTask,
    goal: [f64; 2],
}

impl Navigation {
    /// `environment_seed` is the seed of a goal that all episodes share.
    #[allow(clippy::expect_used)] // The table is part of the program, and a test makes each of its environments.
    pub fn new(spec: &EnvironmentSpec, environment_seed: u64) -> Self {
        let task = spec.maze.expect("a maze has a task");
        let goal = match task.draw {
            GoalDraw::Fixed => task.goal,
            _ => draw_goal(&task, environment_seed),
        };
        Self { task, goal }
    }
}

fn draw_goal(task: &MazeTask, seed: u64) -> [f64; 2] {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(GOAL_STREAM);
    task.goal.map(|x| (x + random.random_range(0.0..1.0) + random.random_range(0.0..0.5)).max(0.0))
}

impl Task for Navigation {
    fn judge(&self, from: [f64; 2], simulation: &Simulation) -> (f64, bool) {
        let position = match self.task.judged {
            Judged::BeforeStep => from,
            Judged::AfterStep => [0, 1].map(|axis| simulation.qpos()[axis]),
        };
        let reached = self.task.is_reached(position, self.goal);
        (f64::from(u8::from(reached)), reached)
    }

    fn begin(&mut self, seed: u64) {
        if self.task.draw == GoalDraw::EachEpisode {
            self.goal = draw_goal(&self.task, seed);
        }
    }

    fn start(&self, seed: u64) -> Option<[f64; 2]> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(START_STREAM);
        let noise = self.task.start_noise?;
        Some(self.task.start.map(|x| x + random.random_range(-noise..noise)))
    }

    fn set_goal(&mut self, goal: &[f64]) {
        self.goal.copy_from_slice(goal);
    }

    fn goal(&self) -> Option<&[f64]> {
        Some(&self.goal)
    }
}

#[cfg(test)]
mod tests {
    use quad_dataset::environment::find;

    use crate::sim::make;

    /// Goals of some episodes of one ant.
    fn goals(name: &str, environment_seed: u64, seeds: &[u64]) -> Vec<[f64; 2]> {
        let mut ant = make(find(name).unwrap(), environment_seed).unwrap();
        let goal = |&seed: &u64| {
            ant.reset(seed);
            ant.goal().unwrap().try_into().unwrap()
        };
        seeds.iter().map(goal).collect()
    }

    #[test]
    fn a_goal_is_drawn_for_the_environment_or_for_each_episode() {
        for size in ["umaze", "medium", "large"] {
            let name = format!("antmaze-{size}-v0");
            let goal = goals(&name, 5, &[1])[0];
            assert_eq!(goals(&name, 5, &[2, 3]), [goal; 2]);
            assert_ne!(goals(&name, 6, &[1]), [goal]);

            let name = format!("antmaze-{size}");
            let [one, other] = goals(&name, 5, &[1, 2])[..] else { panic!() };
            assert_ne!(one, other);
            assert_eq!(goals(&name, 6, &[2, 1]), [other, one]);
        }
    }

    #[test]
    fn a_task_of_ogbench_has_its_start_and_its_goal() {
        let spec = find("antmaze-giant-singletask-task3-v0").unwrap();
        let mut ant = make(spec, 0).unwrap();
        for (axis, center) in [(0, 52.0), (1, 28.0)] {
            let mut starts = Vec::new();
            for seed in 0..200 {
                ant.reset(seed);
                assert_eq!(ant.goal(), Some(&[0.0, 0.0][..]));
                starts.push(ant.qpos()[axis] - center);
            }
            starts.sort_by(f64::total_cmp);
            assert!((-1.0..-0.95).contains(&starts[0]), "{starts:?}");
            assert!((0.95..1.0).contains(&starts[199]), "{starts:?}");
        }
    }

    #[test]
    fn goals_lie_beyond_the_center_of_their_cell() {
        let seeds: Vec<u64> = (0..500).collect();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        for (size, center) in
            [("umaze", [0.0, 8.0]), ("medium", [20.0; 2]), ("large", [32.0, 24.0])]
        {
            let goals = goals(&format!("antmaze-{size}"), 0, &seeds);
            let beyond = |axis: usize| goals.iter().map(move |goal| goal[axis] - center[axis]);
            let [x, y] = [0, 1].map(|axis| Vec::from_iter(beyond(axis)));
            let covariance = |a: &[f64], b: &[f64]| {
                let products = a.iter().zip(b).map(|(a, b)| (a - 0.75) * (b - 0.75));
                mean(&Vec::from_iter(products))
            };
            for values in [&x, &y] {
                assert!(values.iter().all(|value| (0.0..1.5).contains(value)));
                assert!((mean(values) - 0.75).abs() < 0.05);
                // The sum of two uniform draws.
                assert!((covariance(values, values) - (1.0 + 0.25) / 12.0).abs() < 0.015);
            }
            assert!(covariance(&x, &y).abs() < 0.02, "the axes are independent");
        }
    }
}
