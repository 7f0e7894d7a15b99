//! Mazes: a four-legged ant, or a ball, comes through a maze to a goal that it does not observe.
//!
//! The mazes, the ant and the rules are those of D4RL's antmaze-*-v0 and antmaze-*-v2:
//!
//! - qpos (15): the torso's x, y, z and quaternion (w first), then hip and ankle of legs 1 to 4;
//!   qvel (14): the torso's linear and angular velocities, then the joints'. Meters and radians,
//!   per second.
//! - Observation (29): qpos and qvel. The goal is not part of it.
//! - Action (8): torques of hip and ankle of legs 4, 1, 2 and 3, as fractions of 30 Nm, clipped to
//!   ±1; held for 0.1 s.
//! - An episode begins in the maze's `R` and ends in the step that brings the torso's center within
//!   0.5 m of the goal. The reward of that step is 1, of every other 0. Only the goal and the time
//!   limit end an episode: an ant on its back continues.
//! - The goal lies around the corner of cell `G`: on each axis max(0, the cell's center + U(0, 1) +
//!   U(0, 0.5)), drawn when the table says ([`Goal`]).
//!
//! OGBench's antmaze-*-singletask-* differ in three things: the episode begins within 1 m, on each
//! axis, of the center of the task's own cell; the goal is the center of another; and a step is
//! judged where it begins, so that an episode ends one step after the ant has come there. Rewards
//! are 1 more than OGBench's, so that a return is 0 or 1, too.
//!
//! OGBench's pointmaze-*-singletask-* have a ball in place of the ant. It observes x and y. An
//! action (2) puts it at once as much further, as fractions of 0.2 m on each axis, without any
//! velocity; then walls push it back for 0.1 s. It is at the goal within 1 m.

use quad_dataset::environment::Goal;
use quad_dataset::ogbench::{self, ANT_REACH, CELL, MazeTask};
use quad_dataset::{EnvironmentSpec, Noise};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::physics::{Drive, Physics};
use super::simulation::{Body, Task};

/// The stream that a goal is drawn from, among those of an episode's or an environment's seed.
const GOAL_STREAM: u64 = 4;
/// The stream that a start is drawn from, likewise.
const START_STREAM: u64 = 5;
/// Where the model of a robot on its floor has the walls.
const WALLS: &str = "<!-- walls -->";
/// How far from its cell's center, on each axis, an episode of OGBench's begins, meters.
const START_NOISE: f64 = 1.0;
/// Steps of the model that a control is held for, of 0.02 s each.
pub(super) const FRAME_SKIP: usize = 5;
/// How both robots begin. The ball's observation has no room for velocities.
pub(super) const BODY: Body = Body {
    noise: Noise::NormalVelocities(0.1),
    hidden_positions: 0,
    observed_velocity: f64::INFINITY,
};

/// What moves through a maze.
#[derive(Clone, Copy)]
pub(super) struct Robot {
    /// The name of its model, on a floor without walls.
    pub model: &'static str,
    /// How its actions move it.
    pub drive: Drive,
}

impl Robot {
    /// The robot of an environment in a maze, by the environment's name.
    pub fn of(environment: &str) -> Self {
        match environment.starts_with("pointmaze-") {
            true => Self { model: "point", drive: Drive::Displacement(0.2) },
            false => Self { model: "ant", drive: Drive::Motors },
        }
    }
}

/// A maze's map, as its row in the table has it. The world's origin is the center of the cell (1,
/// 1), which is the start.
#[derive(Clone, Copy)]
pub(super) struct Maze(pub &'static [String]);

impl Maze {
    /// The centers (x, y) of the cells of a kind.
    fn centers(self, kind: u8) -> impl Iterator<Item = [f64; 2]> {
        self.0.iter().enumerate().flat_map(move |(i, row)| {
            let cells = row.bytes().enumerate().filter(move |&(_, cell)| cell == kind);
            cells.map(move |(j, _)| [(j as f64 - 1.0) * CELL, (i as f64 - 1.0) * CELL])
        })
    }

    /// The model: `robot`, which has a floor, and a box for each wall, half a cell high.
    pub fn mjcf(self, robot: &str) -> String {
        let walls: String = self
            .centers(b'1')
            .map(|[x, y]| format!("<geom class=\"wall\" pos=\"{x} {y} 1\"/>\n    "))
            .collect();
        robot.replacen(WALLS, walls.trim_end(), 1)
    }

    /// Draws a goal.
    fn draw_goal(self, seed: u64) -> [f64; 2] {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(GOAL_STREAM);
        let center = self.centers(b'G').next().unwrap_or_default();
        center.map(|x| (x + random.random_range(0.0..1.0) + random.random_range(0.0..0.5)).max(0.0))
    }
}

/// The way to a goal.
pub(super) struct Navigation {
    maze: Maze,
    goal: [f64; 2],
    is_redrawn: bool,
    task: Option<MazeTask>,
}

impl Navigation {
    /// `environment_seed` is the seed of a goal that all episodes share.
    pub fn new(maze: Maze, spec: &EnvironmentSpec, environment_seed: u64) -> Self {
        let task = ogbench::maze_task(&spec.name);
        let goal = task.map_or_else(|| maze.draw_goal(environment_seed), |task| task.goal);
        Self { maze, goal, is_redrawn: spec.goal == Some(Goal::EachEpisode), task }
    }
}

impl Task for Navigation {
    fn judge(&self, from: [f64; 2], physics: &Physics) -> (f64, bool) {
        let place =
            if self.task.is_some() { from } else { [0, 1].map(|axis| physics.qpos()[axis]) };
        let [dx, dy] = [0, 1].map(|axis| place[axis] - self.goal[axis]);
        let reached = (dx * dx + dy * dy).sqrt() <= self.task.map_or(ANT_REACH, |task| task.reach);
        (f64::from(u8::from(reached)), reached)
    }

    fn begin(&mut self, seed: u64) {
        if self.is_redrawn {
            self.goal = self.maze.draw_goal(seed);
        }
    }

    fn start(&self, seed: u64) -> Option<[f64; 2]> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(START_STREAM);
        self.task.map(|task| task.start.map(|x| x + random.random_range(-START_NOISE..START_NOISE)))
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

    /// The goals of some episodes of one ant.
    fn goals(name: &str, environment_seed: u64, seeds: &[u64]) -> Vec<Vec<f64>> {
        let mut ant = make(find(name).unwrap(), environment_seed).unwrap();
        let goal = |&seed: &u64| {
            ant.reset(seed);
            ant.goal().unwrap().to_vec()
        };
        seeds.iter().map(goal).collect()
    }

    #[test]
    fn a_goal_is_of_the_environment_s_seed_or_drawn_for_the_episode() {
        for size in ["umaze", "medium", "large"] {
            let kept = format!("antmaze-{size}-v0");
            let goal = goals(&kept, 5, &[1]);
            assert_eq!(goals(&kept, 5, &[2, 3]), [goal[0].clone(), goal[0].clone()]);
            assert_ne!(goals(&kept, 6, &[1]), goal);

            let drawn = format!("antmaze-{size}");
            let mut two = goals(&drawn, 5, &[1, 2]);
            assert_ne!(two[0], two[1]);
            two.reverse();
            assert_eq!(goals(&drawn, 6, &[2, 1]), two);
        }
    }

    #[test]
    fn a_task_of_ogbench_has_its_start_and_its_goal_and_ends_a_step_after() {
        let spec = find("antmaze-giant-singletask-task3-v0").unwrap();
        let mut ant = make(spec, 0).unwrap();
        let mut starts = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
        for seed in 0..200 {
            ant.reset(seed);
            assert_eq!(ant.goal(), Some(&[0.0, 0.0][..]));
            for ([least, most], (x, center)) in
                starts.iter_mut().zip(ant.qpos().iter().zip([52.0, 28.0]))
            {
                (*least, *most) = (least.min(x - center), most.max(x - center));
            }
        }
        assert!(
            starts
                .iter()
                .all(|[least, most]| (-1.0..-0.95).contains(least) && (0.95..1.0).contains(most))
        );
        let [mut qpos, qvel] = [ant.qpos().to_vec(), vec![0.0; 14]];
        qpos[..2].copy_from_slice(&[0.0, 0.51]);
        let mut step = |velocity: f64| {
            let mut qvel = qvel.clone();
            qvel[1] = velocity;
            ant.set_state(&qpos, &qvel);
            let [first, second] = [ant.step(&[0.0; 8]), ant.step(&[0.0; 8])];
            [(first.reward, first.terminated), (second.reward, second.terminated)]
        };
        assert_eq!(step(-1.0), [(0.0, false), (1.0, true)], "it comes there");
        assert_eq!(step(1.0), [(0.0, false), (0.0, false)], "it leaves");
    }

    #[test]
    fn goals_lie_beyond_the_center_of_their_cell() {
        let seeds: Vec<u64> = (0..500).collect();
        for (name, center) in
            [("umaze", [0.0, 8.0]), ("medium", [20.0, 20.0]), ("large", [32.0, 24.0])]
        {
            let goals = goals(&format!("antmaze-{name}"), 0, &seeds);
            for axis in [0, 1] {
                let beyond: Vec<f64> = goals.iter().map(|goal| goal[axis] - center[axis]).collect();
                let mean = beyond.iter().sum::<f64>() / beyond.len() as f64;
                let variance =
                    beyond.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / beyond.len() as f64;
                assert!(beyond.iter().all(|x| (0.0..1.5).contains(x)));
                assert!((mean - 0.75).abs() < 0.05, "{mean}");
                assert!(
                    (variance - (1.0 + 0.25) / 12.0).abs() < 0.015,
                    "{variance}: two uniform draws"
                );
            }
            let products = goals
                .iter()
                .map(|goal| (goal[0] - center[0] - 0.75) * (goal[1] - center[1] - 0.75));
            assert!(products.sum::<f64>().abs() / 500.0 < 0.02, "the axes are drawn apart");
        }
    }
}
