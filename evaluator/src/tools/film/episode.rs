//! Plays an episode and keeps every pose of it, for pictures that are drawn afterwards.

use std::sync::mpsc::{Sender, channel};

use quad_protocol::episode_seeds;

use crate::sim::{self, Environment, EnvironmentError, Simulation, Step};
use crate::tools::score::Subject;

/// What one picture shows.
#[derive(Clone, Debug, PartialEq)]
pub struct Pose {
    /// Generalized positions, as many as the model has.
    pub qpos: Vec<f64>,
    /// The position of the goal (x and y, meters), in a task that has one.
    pub goal: Option<[f64; 2]>,
    /// Undiscounted sum of the rewards so far.
    pub episode_return: f64,
}

/// An episode of a policy.
pub struct Episode {
    /// Its seed.
    pub seed: u64,
    /// The pose at the beginning, then one after each step.
    pub poses: Vec<Pose>,
    /// Gradient step of the policy.
    pub gradient_step: u64,
    /// How the policy chooses, as text.
    pub choice: String,
}

impl Episode {
    /// Plays the episode of a seed; without one, of the first seed on which the run evaluates the
    /// subject. `environment_seed` is the seed of what the environment draws once for all episodes.
    ///
    /// # Errors
    /// The policy cannot act.
    pub fn play(
        subject: &Subject,
        seed: Option<u64>,
        environment_seed: u64,
    ) -> anyhow::Result<Self> {
        let seed = seed.unwrap_or_else(|| episode_seeds(subject.seed, subject.step, 1)[0]);
        let (told, poses) = channel();
        let watched = || -> Result<Box<dyn Environment>, EnvironmentError> {
            let simulation = sim::make(subject.spec, environment_seed)?;
            Ok(Box::new(Watched { simulation, episode_return: 0.0, told: told.clone() }))
        };
        subject.roll_out(watched, &[seed])?;
        let choice = subject
            .policy
            .choice()
            .map_or_else(|| "no candidates".to_owned(), |choice| choice.to_string());
        Ok(Self { seed, poses: poses.try_iter().collect(), gradient_step: subject.step, choice })
    }

    /// Both columns of the caption after `steps` steps; later than the end, those of the end.
    pub fn caption(&self, steps: usize) -> [String; 2] {
        let Self { gradient_step, choice, .. } = self;
        let step = if steps < self.length() {
            steps.to_string()
        } else {
            format!("{}, end", self.length())
        };
        let episode_return = self.pose(steps).episode_return;
        [
            format!("trained {gradient_step}\nstep {step}"),
            format!("return {episode_return:.1}\n{choice}"),
        ]
    }

    /// The pose after `steps` steps; later than the end, the last pose.
    pub fn pose(&self, steps: usize) -> &Pose {
        &self.poses[steps.min(self.length())]
    }

    /// Its number of steps.
    pub fn length(&self) -> usize {
        self.poses.len() - 1
    }
}

/// A simulation that reports each of its poses.
struct Watched {
    simulation: Simulation,
    episode_return: f64,
    told: Sender<Pose>,
}

impl Watched {
    fn tell(&self) {
        let goal = self.simulation.goal().and_then(|goal| goal.try_into().ok());
        let pose = Pose {
            qpos: self.simulation.qpos().to_vec(),
            goal,
            episode_return: self.episode_return,
        };
        // The receiver outlives the rollout.
        let _ = self.told.send(pose);
    }
}

impl Environment for Watched {
    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError> {
        self.simulation.reset(seed);
        self.tell();
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        let step = self.simulation.step(action);
        self.episode_return += step.reward;
        self.tell();
        Ok(step)
    }

    fn observation(&self) -> &[f64] {
        self.simulation.observation()
    }

    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
        self.simulation.score(episode_return)
    }
}
