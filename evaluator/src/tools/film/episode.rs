//! Plays an episode and keeps its poses, which are drawn afterwards.

use quad_protocol::episode_seeds;

use crate::sim::Simulation;
use crate::tools::score::Subject;

/// Subject of one picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Pose {
    /// Generalized positions.
    pub qpos: Vec<f64>,
    /// The goal's x and y, meters, in a task that has one.
    pub goal: Option<[f64; 2]>,
    /// Undiscounted sum of the rewards so far.
    pub episode_return: f64,
}

/// An episode of a policy.
pub struct Episode {
    pub seed: u64,
    /// The initial pose, then one after each step.
    poses: Vec<Pose>,
    /// Gradient step of the policy.
    gradient_step: u64,
    /// The policy's way to choose, as text.
    pub choice: String,
}

impl Episode {
    /// Plays the episode of a seed; without one, of the first seed on which the run evaluates the
    /// subject. `environment_seed` decides what the environment draws once for all episodes.
    pub fn play(
        subject: &Subject,
        seed: Option<u64>,
        environment_seed: u64,
    ) -> anyhow::Result<Self> {
        let seed = seed.unwrap_or_else(|| episode_seeds(subject.seed, subject.step, 1)[0]);
        let mut poses = Vec::new();
        let see = |simulation: &Simulation, so_far| poses.push(pose(simulation, so_far));
        let (last, episode_return) = subject.play(seed, environment_seed, see)?;
        poses.push(pose(&last, episode_return));
        let choice = subject.policy.choice().map(|choice| choice.to_string());
        let choice = choice.unwrap_or_else(|| "no candidates".to_owned());
        Ok(Self { seed, poses, gradient_step: subject.step, choice })
    }

    /// Both columns of the caption after `steps` steps, or at the end if that is earlier.
    pub fn caption(&self, steps: usize) -> [String; 2] {
        let Self { gradient_step, choice, .. } = self;
        let end = if steps < self.length() { "" } else { ", end" };
        let step = steps.min(self.length());
        let episode_return = self.pose(steps).episode_return;
        [
            format!("trained {gradient_step}\nstep {step}{end}"),
            format!("return {episode_return:.1}\n{choice}"),
        ]
    }

    /// The pose after `steps` steps, or at the end if that is earlier.
    pub fn pose(&self, steps: usize) -> &Pose {
        &self.poses[steps.min(self.length())]
    }

    /// Number of steps.
    pub fn length(&self) -> usize {
        self.poses.len() - 1
    }
}

fn pose(simulation: &Simulation, episode_return: f64) -> Pose {
    let goal = simulation.goal().and_then(|goal| goal.try_into().ok());
    Pose { qpos: simulation.qpos().to_vec(), goal, episode_return }
}
