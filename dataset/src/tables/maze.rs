//! Tasks in mazes: a robot goes from a start to a goal.

use serde::Deserialize;

use crate::recording::{Recording, RowKind};

/// Side of a maze's cell, meters.
pub const CELL: f64 = 4.0;

/// When the goal of a maze is drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GoalDraw {
    /// Never: it is the center of its cell.
    #[default]
    Fixed,
    /// Once, when the environment is made (D4RL's AntMaze v0 and v1).
    EachInstance,
    /// At each reset (D4RL's AntMaze v2).
    EachEpisode,
}

/// The state of a step that is tested for the goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Judged {
    /// The one in which the action is chosen (OGBench), so an episode ends a step after the goal.
    BeforeStep,
    /// The one to which the action leads (D4RL).
    AfterStep,
}

/// A task in a maze. Its reward is 1 in a step that reaches the goal, else 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MazeTask {
    /// Center of the cell where the robot starts: x and y, meters.
    pub start: [f64; 2],
    /// Largest distance from there on each axis, meters; without, the robot starts where its model
    /// is.
    pub start_noise: Option<f64>,
    /// Center of the goal's cell: x and y, meters.
    pub goal: [f64; 2],
    /// When the goal is drawn.
    pub draw: GoalDraw,
    /// Distance from the goal, in the plane, within which it is reached, meters.
    pub reach: f64,
    /// The state that is tested for the goal.
    pub judged: Judged,
    /// Index in an observation of the x of what must reach the goal; y follows.
    pub measured: usize,
}

impl MazeTask {
    /// Whether a position is within reach of a goal, both x and y in meters.
    pub fn is_reached(&self, position: [f64; 2], goal: [f64; 2]) -> bool {
        let [dx, dy] = [0, 1].map(|axis| position[axis] - goal[axis]);
        (dx * dx + dy * dy).sqrt() <= self.reach
    }

    /// Replaces a recording's rewards and masks by those of this task, of the state before a step.
    pub(crate) fn label(&self, recording: &mut Recording) {
        for row in 0..recording.rows() {
            let position = recording.observation(row).get(self.measured..self.measured + 2);
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
