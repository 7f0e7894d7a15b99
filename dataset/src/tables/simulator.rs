//! The numbers by which evaluators simulate an environment and record data in it.

use serde::Deserialize;

/// How an environment is simulated.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Simulator {
    /// A robot that runs in a vertical plane.
    Planar(Planar),
    /// A robot in a maze of these rows of cells along +y, in them cells along +x: 1 wall, 0 free.
    #[serde(skip)]
    Maze(&'static Robot, &'static [String]),
}

/// A robot that moves through mazes.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Robot {
    /// Name of its model.
    pub name: String,
    pub(super) observation_dim: usize,
    pub(super) action_dim: usize,
    pub(super) qpos_dim: usize,
    pub(super) qvel_dim: usize,
    /// Steps of the model that a control is held for.
    pub frame_skip: usize,
    /// Noise on the initial state.
    pub noise: Noise,
    /// Effect of its actions.
    pub drive: Drive,
}

/// Effect of an action.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Drive {
    /// Torques, as fractions of each motor's strongest.
    Motors,
    /// Displacements before a step, as fractions of this many meters; velocities become 0.
    Displacement(f64),
}

/// A robot in a vertical plane that is rewarded for running along x. Positions begin with its x, z
/// (meters) and pitch (radians); a policy observes all but x, then the velocities.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Planar {
    /// Steps of the model that a control is held for.
    pub frame_skip: usize,
    /// Noise on the initial state.
    pub noise: Noise,
    /// Reward of every step.
    pub alive_bonus: f64,
    /// Cost of a squared action.
    pub control_cost: f64,
    /// Limit of each observed velocity.
    #[serde(default = "unlimited")]
    pub observed_velocity: f64,
    /// Limits within which an episode continues; without any it always does.
    #[serde(default)]
    pub healthy: Option<Healthy>,
}

fn unlimited() -> f64 {
    f64::INFINITY
}

/// Noise that is added to each position and velocity of the initial state.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Noise {
    /// Uniform within ± this.
    Uniform(f64),
    /// Positions: uniform within ± this; velocities: normal with this standard deviation.
    NormalVelocities(f64),
}

/// Limits, themselves excluded, within which an episode continues.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Healthy {
    /// Height of the torso, meters.
    pub z: (f64, f64),
    /// Pitch of the torso, radians.
    pub pitch: (f64, f64),
    /// Limit of every position but x and z, and of every velocity.
    #[serde(default)]
    pub others: Option<f64>,
}

impl Healthy {
    /// Whether an episode continues in a state. False for NaN, because no comparison with NaN
    /// holds.
    pub fn contains(&self, qpos: &[f64], qvel: &[f64]) -> bool {
        let within = |(min, max): (f64, f64), value: f64| value > min && value < max;
        let mut others = qpos[2..].iter().chain(qvel);
        within(self.z, qpos[1])
            && within(self.pitch, qpos[2])
            && self.others.is_none_or(|limit| others.all(|value| value.abs() < limit))
    }
}

/// Recipe by which a dataset of mediocre behavior is recorded.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Independent searches. Each finds its own gait, so that the recorded actions in a state
    /// differ by more than noise.
    pub searches: u64,
    /// Steps that the searches may take for each recorded transition.
    pub steps_per_transition: u64,
    /// Bands of normalized score: the lower bound of each, and its share of the transitions.
    ///
    /// Without shares, a search's history is mostly long, good episodes, from which offline
    /// learning can gain little. The shares make a mixture with any seed: good actions exist, among
    /// worse ones in the same states.
    pub mixture: Vec<(f64, f64)>,
}
