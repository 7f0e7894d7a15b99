//! Simulation and recording parameters of environments.

use serde::Deserialize;

/// Kind of simulation.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Simulator {
    /// Robot that runs in a vertical plane.
    Planar(Planar),
    /// Robot in a maze with rows of cells along +y and columns along +x: 1 wall, 0 free.
    #[serde(skip)]
    Maze(&'static Robot, &'static [String]),
}

/// Robot that moves through mazes.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Robot {
    /// Name of its MuJoCo model.
    pub name: String,
    pub(super) observation_dim: usize,
    pub(super) action_dim: usize,
    pub(super) qpos_dim: usize,
    pub(super) qvel_dim: usize,
    /// Simulation steps per action.
    pub frame_skip: usize,
    /// Noise on the initial state.
    pub noise: Noise,
    /// Motors, or displacement of a point.
    pub drive: Drive,
}

/// Map from an action to the simulator.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Drive {
    /// Torques, as fractions of each motor's maximum.
    Motors,
    /// Displacement before a step, as a fraction of this many meters; velocities are set to 0.
    Displacement(f64),
}

/// Robot in a vertical plane, rewarded for running along x. `qpos` starts with x, z (meters) and
/// pitch (radians); an observation is `qpos` without x, then `qvel`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Planar {
    /// Simulation steps per action.
    pub frame_skip: usize,
    /// Noise on the initial state.
    pub noise: Noise,
    /// Reward per step.
    pub alive_bonus: f64,
    /// True if the step that ends an episode earns the bonus, too.
    #[serde(default = "always")]
    pub bonus_at_end: bool,
    /// Cost weight of the squared action.
    pub control_cost: f64,
    /// Clipping of observed velocities.
    #[serde(default = "unlimited")]
    pub observed_velocity: f64,
    /// Region outside of which an episode terminates, if any.
    #[serde(default)]
    pub healthy: Option<Healthy>,
}

fn always() -> bool {
    true
}

fn unlimited() -> f64 {
    f64::INFINITY
}

/// Noise on each position and velocity of the initial state.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Noise {
    /// Uniform within ± this.
    Uniform(f64),
    /// Positions: uniform within ± this; velocities: normal with this standard deviation.
    NormalVelocities(f64),
}

/// Open intervals outside of which an episode terminates.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Healthy {
    /// Height of the torso, meters.
    pub z: (f64, f64),
    /// Pitch of the torso, radians.
    pub pitch: (f64, f64),
    /// Limit of all positions except x and z, and of all velocities.
    #[serde(default)]
    pub limit: Option<f64>,
}

impl Healthy {
    /// True if an episode continues in a state; false with NaN.
    pub fn contains(&self, qpos: &[f64], qvel: &[f64]) -> bool {
        let within = |(min, max): (f64, f64), value: f64| value > min && value < max;
        let mut limited = qpos[2..].iter().chain(qvel);
        within(self.z, qpos[1])
            && within(self.pitch, qpos[2])
            && self.limit.is_none_or(|limit| limited.all(|value| value.abs() < limit))
    }
}

/// Recipe for recording a dataset of mixed quality.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Independent policy searches. Their different gaits make the recorded actions multimodal.
    pub searches: u64,
    /// Search steps per recorded transition.
    pub steps_per_transition: u64,
    /// Bins of normalized score: lower bound and share of the transitions. Without shares, most
    /// rows would be long, good episodes, which leave little for offline learning to improve.
    pub mixture: Vec<(f64, f64)>,
}
