//! Maze navigation tasks.

use serde::Deserialize;

use crate::recording::{Recording, RowKind};

/// Side of a maze cell, meters.
pub const CELL: f64 = 4.0;

/// Randomization of a maze's goal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GoalDraw {
    /// Fixed at the center of its cell.
    #[default]
    Fixed,
    /// Drawn when the environment is created (D4RL's AntMaze v0 and v1).
    EachInstance,
    /// Drawn at each reset (D4RL's AntMaze v2).
    EachEpisode,
}

/// State compared with the goal in a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Judged {
    /// State before the action (OGBench); the episode ends one step after the goal.
    BeforeStep,
    /// State after the action (D4RL).
    AfterStep,
}

/// Maze navigation task, with reward 1 in a step that reaches the goal, else 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MazeTask {
    /// Center of the start cell: x and y, meters.
    pub start: [f64; 2],
    /// Largest offset of the start on each axis, meters; `None` for the model's initial position.
    pub start_noise: Option<f64>,
    /// Center of the goal cell: x and y, meters.
    pub goal: [f64; 2],
    /// Randomization of the goal.
    pub draw: GoalDraw,
    /// Distance in the plane within which the goal is reached, meters.
    pub reach: f64,
    /// State compared with the goal.
    pub judged: Judged,
    /// Index in an observation of the x coordinate compared with the goal; y follows.
    pub measured: usize,
}

impl MazeTask {
    /// True if a position is within reach of the goal, both x and y in meters.
    pub fn is_reached(&self, position: [f64; 2], goal: [f64; 2]) -> bool {
        let [dx, dy] = [0, 1].map(|axis| position[axis] - goal[axis]);
        (dx * dx + dy * dy).sqrt() <= self.reach
    }

    /// Replaces rewards and masks by those of this task, evaluated in the state before each step.
    pub(crate) fn label(&self, recording: &mut Recording) {
        for row in 0..recording.rows() {
            let state = recording.observation(row);
            let position = state.get(self.measured..self.measured + 2);
            let is_reached = position.is_some_and(|position| {
                self.is_reached([position[0], position[1]].map(f64::from), self.goal)
            });
            recording.rewards[row] = f32::from(u8::from(is_reached));
            recording.terminals[row] = is_reached && recording.kinds[row] != RowKind::LastState;
            recording.timeouts[row] = recording.ends[row] && !is_reached;
        }
        recording.goal = true;
    }
}
