//! AntMaze: a four-legged ant walks through a maze to a goal that it does not observe.
//!
//! The mazes, the ant and the rules are those of D4RL's antmaze-*-v0 and antmaze-*-v2:
//!
//! - qpos (15): the torso's x, y, z and quaternion (w first), then hip and ankle of legs 1 to 4; qvel (14): the torso's
//!   linear and angular velocities, then the joints'. Metres and radians, per second.
//! - Observation (29): qpos and qvel. The goal is not part of it.
//! - Action (8): torques of hip and ankle of legs 4, 1, 2 and 3, as fractions of 30 Nm, clipped to ±1; held for 0.1 s.
//! - An episode begins in the maze's `R` and ends in the step that brings the torso's centre within 0.5 m of the goal. The
//!   reward of that step is 1, of every other 0. Only the goal and the time limit end an episode: an ant on its back
//!   continues.
//! - The goal lies around the corner of cell `G`: on each axis max(0, the cell's centre + U(0, 1) + U(0, 0.5)), drawn when
//!   the table says ([`Goal`]).
//!
//! As in the locomotion tasks, a simulation that diverges and an action that is not a number end the episode, with reward 0.

use quad_dataset::environment::{EnvironmentSpec, Goal};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::environment::{EnvironmentError, Step};
use super::physics::{self, Noise, Physics};
use super::simulation::{GOAL_STREAM, Simulation};

/// The ant on its floor; [`WALLS`] marks the place of the walls.
const ANT: &str = include_str!("../../assets/ant.xml");
const WALLS: &str = "<!-- walls -->";
/// Side of a maze's cell, metres.
const CELL: f64 = 4.0;
/// Model steps a control is held for, of 0.02 s each.
const FRAME_SKIP: usize = 5;
const NOISE: Noise = Noise::NormalVelocities(0.1);
/// Distance in the plane from the torso's centre to the goal at which it is reached, metres.
const REACH: f64 = 0.5;

/// A maze.
pub(super) struct Maze {
    /// The simulation's name in the table of environments.
    pub name: &'static str,
    /// Rows of cells along +y, in them cells along +x: `1` wall, `0` free, `R` start, `G` goal. The world's origin is the
    /// centre of the cell (1, 1), which is the start.
    map: &'static [&'static str],
}

pub(super) static MAZES: [Maze; 3] = [
    Maze { name: "antmaze-umaze", map: &["11111", "1R001", "11101", "1G001", "11111"] },
    Maze {
        name: "antmaze-medium",
        map: &["11111111", "1R011001", "10010001", "11000111", "10010001", "10100101", "100010G1", "11111111"],
    },
    Maze {
        name: "antmaze-large",
        map: &[
            "111111111111",
            "1R0001000001",
            "101101010101",
            "100000010001",
            "101111011101",
            "100101000001",
            "110101010111",
            "100100010G01",
            "111111111111",
        ],
    },
];

impl Maze {
    /// The centres (x, y) of the cells of a kind.
    fn centres(&self, kind: u8) -> impl Iterator<Item = [f64; 2]> {
        self.map.iter().enumerate().flat_map(move |(i, row)| {
            let cells = row.bytes().enumerate().filter(move |&(_, cell)| cell == kind);
            cells.map(move |(j, _)| [(j as f64 - 1.0) * CELL, (i as f64 - 1.0) * CELL])
        })
    }

    /// The model: the ant, the floor, and a box for each wall, half a cell high.
    pub fn mjcf(&self) -> String {
        let walls: String =
            self.centres(b'1').map(|[x, y]| format!("<geom class=\"wall\" pos=\"{x} {y} 1\"/>\n    ")).collect();
        ANT.replacen(WALLS, walls.trim_end(), 1)
    }

    /// Draws a goal.
    fn draw_goal(&self, seed: u64) -> [f64; 2] {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(GOAL_STREAM);
        let centre = self.centres(b'G').next().unwrap_or_default();
        centre.map(|x| (x + random.random_range(0.0..1.0) + random.random_range(0.0..0.5)).max(0.0))
    }
}

/// An ant in a maze.
pub(super) struct AntMaze {
    maze: &'static Maze,
    physics: Physics,
    observation: Vec<f64>,
    goal: [f64; 2],
    goal_drawn: Goal,
    steps: usize,
    max_episode_steps: usize,
}

impl AntMaze {
    /// An ant that waits for its first [`reset`](Simulation::reset). `environment_seed` is the seed of a goal that all
    /// episodes share.
    pub fn new(maze: &'static Maze, spec: &EnvironmentSpec, environment_seed: u64) -> Result<Self, EnvironmentError> {
        let model = physics::model(maze.name, || maze.mjcf())?;
        Ok(Self {
            maze,
            physics: Physics::new(model, FRAME_SKIP)?,
            observation: vec![0.0; spec.observation_dim],
            goal: maze.draw_goal(environment_seed),
            goal_drawn: spec.goal.unwrap_or(Goal::EachEpisode),
            steps: 0,
            max_episode_steps: spec.max_episode_steps,
        })
    }

    fn start(&mut self) {
        self.steps = 0;
        self.observe();
    }

    fn observe(&mut self) {
        let (positions, velocities) = self.observation.split_at_mut(self.physics.qpos().len());
        positions.copy_from_slice(self.physics.qpos());
        velocities.copy_from_slice(self.physics.qvel());
    }
}

impl Simulation for AntMaze {
    fn reset(&mut self, seed: u64) {
        if self.goal_drawn == Goal::EachEpisode {
            self.goal = self.maze.draw_goal(seed);
        }
        self.physics.reset(seed, NOISE);
        self.start();
    }

    fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) {
        self.physics.set_state(qpos, qvel);
        self.start();
    }

    fn set_goal(&mut self, goal: &[f64]) {
        self.goal.copy_from_slice(goal);
    }

    fn goal(&self) -> Option<&[f64]> {
        Some(&self.goal)
    }

    fn step(&mut self, action: &[f32]) -> Step {
        self.steps += 1;
        let truncated = self.steps >= self.max_episode_steps;
        let went_on = self.physics.step(action);
        self.observe();
        if !went_on {
            return Step { reward: 0.0, terminated: true, truncated };
        }
        let [dx, dy] = [0, 1].map(|axis| self.physics.qpos()[axis] - self.goal[axis]);
        let reached = (dx * dx + dy * dy).sqrt() <= REACH;
        Step { reward: f64::from(u8::from(reached)), terminated: reached, truncated }
    }

    fn control_period(&self) -> f64 {
        self.physics.dt()
    }

    fn observation(&self) -> &[f64] {
        &self.observation
    }

    fn qpos(&self) -> &[f64] {
        self.physics.qpos()
    }

    fn qvel(&self) -> &[f64] {
        self.physics.qvel()
    }
}

#[cfg(test)]
mod tests {
    use quad_dataset::environment::find;

    use super::*;

    fn ant(name: &str, environment_seed: u64) -> AntMaze {
        let spec = find(name).unwrap();
        let maze = MAZES.iter().find(|maze| maze.name == spec.simulation()).unwrap();
        AntMaze::new(maze, spec, environment_seed).unwrap()
    }

    /// The goals of some episodes of one ant.
    fn goals(name: &str, environment_seed: u64, seeds: &[u64]) -> Vec<[f64; 2]> {
        let mut ant = ant(name, environment_seed);
        let goal = |&seed: &u64| {
            ant.reset(seed);
            ant.goal
        };
        seeds.iter().map(goal).collect()
    }

    #[test]
    fn a_goal_is_of_the_environment_s_seed_or_drawn_for_the_episode() {
        for size in ["umaze", "medium", "large"] {
            let kept = format!("antmaze-{size}-v0");
            let [first, second] = goals(&kept, 5, &[1, 2])[..] else { panic!() };
            assert_eq!(first, second);
            assert_eq!(goals(&kept, 5, &[3]), [first]);
            assert_ne!(goals(&kept, 6, &[1]), [first]);

            let drawn = format!("antmaze-{size}");
            let [first, second] = goals(&drawn, 5, &[1, 2])[..] else { panic!() };
            assert_ne!(first, second);
            assert_eq!(goals(&drawn, 6, &[2, 1]), [second, first]);
        }
    }

    #[test]
    fn goals_lie_beyond_the_centre_of_their_cell() {
        let seeds: Vec<u64> = (0..500).collect();
        for (name, centre) in [("umaze", [0.0, 8.0]), ("medium", [20.0, 20.0]), ("large", [32.0, 24.0])] {
            let goals = goals(&format!("antmaze-{name}"), 0, &seeds);
            for axis in [0, 1] {
                let beyond: Vec<f64> = goals.iter().map(|goal| goal[axis] - centre[axis]).collect();
                let mean = beyond.iter().sum::<f64>() / beyond.len() as f64;
                let variance = beyond.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / beyond.len() as f64;
                assert!(beyond.iter().all(|x| (0.0..1.5).contains(x)));
                assert!((mean - 0.75).abs() < 0.05, "{mean}");
                assert!((variance - (1.0 + 0.25) / 12.0).abs() < 0.015, "{variance}: two uniform draws");
            }
            let products = goals.iter().map(|goal| (goal[0] - centre[0] - 0.75) * (goal[1] - centre[1] - 0.75));
            assert!(products.sum::<f64>().abs() / 500.0 < 0.02, "the axes are drawn apart");
        }
    }
}
