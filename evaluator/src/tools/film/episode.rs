//! Plays an episode and keeps its poses, which are drawn afterwards.

use anyhow::Context;
use quad_protocol::episode_seeds;

use crate::sim::{self, Simulation};
use crate::tools::score::{Subject, title};

/// Subject of one picture.
pub struct Pose {
    /// Generalized positions.
    pub qpos: Vec<f64>,
    /// The goal's x and y, meters, in a task that has one.
    pub goal: Option<[f64; 2]>,
    /// Undiscounted sum of the rewards so far.
    pub episode_return: f64,
}

impl Pose {
    fn new(simulation: &Simulation, episode_return: f64) -> Self {
        let goal = simulation.goal().and_then(|goal| goal.try_into().ok());
        Self { qpos: simulation.qpos().to_vec(), goal, episode_return }
    }
}

/// An episode of a policy.
pub struct FilmedEpisode {
    pub seed: u64,
    /// The initial pose, then one after each step.
    poses: Vec<Pose>,
    /// Gradient step of the policy.
    gradient_step: u64,
    /// The policy's way to choose, as text.
    pub choice: String,
}

impl FilmedEpisode {
    /// Plays the episode of a seed; without one, of the first seed on which the run evaluates the
    /// subject. `environment_seed` decides what the environment draws once for all episodes.
    pub fn play(
        subject: &Subject,
        seed: Option<u64>,
        environment_seed: u64,
    ) -> anyhow::Result<Self> {
        let seed = seed.unwrap_or_else(|| episode_seeds(subject.seed, subject.step, 1)[0]);
        let policy = &*subject.policy;
        let mut simulation = sim::make(subject.spec, environment_seed)?;
        simulation.reset(seed);
        let (mut state, mut action) = ([policy.begin(seed)], vec![0.0; policy.action_dim()]);
        let mut poses = vec![Pose::new(&simulation, 0.0)];
        loop {
            let observation = simulation.observation().iter().map(|x| *x as f32);
            let acted = policy.act(&Vec::from_iter(observation), &mut state, &mut action);
            acted.with_context(|| subject.cannot_act())?;
            let step = simulation.step(&action);
            poses.push(Pose::new(&simulation, poses[poses.len() - 1].episode_return + step.reward));
            if step.terminated || step.truncated {
                break;
            }
        }
        Ok(Self { seed, poses, gradient_step: subject.step, choice: title(policy.choice()) })
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
