//! What an environment is: the seam between a policy and whatever moves the task, in this program or in another language.

use quad_dataset::EnvironmentSpec;
use thiserror::Error;

use super::simulation::Simulation;

/// What one step of an environment gave.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// The reward of this step.
    pub reward: f64,
    /// The task ended the episode here: there is no future to bootstrap from.
    pub terminated: bool,
    /// The time limit was reached here. Independent of `terminated`, as in Gymnasium: both may be true.
    pub truncated: bool,
}

/// A place to act in, as a rollout needs it.
pub trait Environment: Send {
    /// Starts an episode, which is a function of its seed and its actions alone.
    ///
    /// # Errors
    /// The environment broke down. So may each of the next two.
    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError>;

    /// Applies an action for one control period.
    ///
    /// # Errors
    /// As [`Self::reset`].
    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError>;

    /// The current observation.
    fn observation(&self) -> &[f64];

    /// The score of the episode that has ended, given the undiscounted sum of its rewards.
    ///
    /// # Errors
    /// As [`Self::reset`].
    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError>;
}

/// What an evaluator can make environments of.
pub trait Environments: Send + Sync {
    /// The names that learners may ask for.
    fn names(&self) -> Vec<String>;

    /// Numbers in an observation and in an action, where they are known before there is an environment.
    fn sizes(&self, name: &str) -> Option<(usize, usize)>;

    /// Makes an environment. `environment_seed` is that of what it draws once and keeps over all episodes, if there is any
    /// such thing.
    ///
    /// # Errors
    /// The name is none of [`Self::names`], or the environment cannot be made.
    fn make(&self, name: &str, environment_seed: u64) -> Result<Box<dyn Environment>, EnvironmentError>;
}

/// A simulation of this program as an environment, with D4RL's normalised score.
pub(super) struct Simulated {
    pub simulation: Box<dyn Simulation>,
    pub spec: &'static EnvironmentSpec,
}

impl Environment for Simulated {
    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError> {
        self.simulation.reset(seed);
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        Ok(self.simulation.step(action))
    }

    fn observation(&self) -> &[f64] {
        self.simulation.observation()
    }

    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
        Ok(self.spec.normalised_score(episode_return))
    }
}

/// Why there is no environment, or none any more.
#[derive(Debug, Error)]
pub enum EnvironmentError {
    /// The name is known to the dataset crate, but this evaluator has no simulation of it.
    #[error("this evaluator cannot simulate the environment \"{0}\"")]
    NotSimulated(String),
    /// It gave an observation of another size than the policy takes.
    #[error("an observation has {found} numbers, but the policy takes {wanted}")]
    Observation {
        /// Numbers that it gave.
        found: usize,
        /// Numbers that the policy takes.
        wanted: usize,
    },
    /// It broke down, in its own words.
    #[error("the environment \"{name}\" failed: {reason}")]
    Failed {
        /// Which.
        name: String,
        /// Why.
        reason: String,
    },
    /// MuJoCo refused the embedded model: the library is not the version that this program was built for.
    #[error("MuJoCo could not compile the model of \"{simulation}\": {reason}")]
    Model {
        /// Whose model.
        simulation: &'static str,
        /// MuJoCo's own words.
        reason: String,
    },
    /// MuJoCo could not allocate the state of a simulation.
    #[error("MuJoCo could not allocate the state of a simulation: {0}")]
    Allocation(String),
}
