//! What an environment is: the interface between a policy and a simulation, in this program or in another language.

use thiserror::Error;

/// The result of one step of an environment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// The reward of this step.
    pub reward: f64,
    /// The task ended the episode here: there is no future to bootstrap from.
    pub terminated: bool,
    /// The time limit was reached here. Independent of `terminated`, as in Gymnasium: both may be true.
    pub truncated: bool,
}

/// An environment, as a rollout needs it.
pub trait Environment: Send {
    /// Starts an episode, which is a function of its seed and its actions only.
    ///
    /// # Errors
    /// The environment failed; so may the next two methods.
    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError>;

    /// Applies an action for one control period.
    ///
    /// # Errors
    /// As [`Self::reset`].
    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError>;

    /// The current observation.
    fn observation(&self) -> &[f64];

    /// The score of the ended episode, given the undiscounted sum of its rewards.
    ///
    /// # Errors
    /// As [`Self::reset`].
    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError>;
}

/// Makes environments for an evaluator.
pub trait Environments: Send + Sync {
    /// The names that learners may ask for.
    fn names(&self) -> Vec<String>;

    /// The sizes of an observation and of an action, if they are known before an environment exists.
    fn sizes(&self, name: &str) -> Option<(usize, usize)>;

    /// Makes an environment. `environment_seed` is the seed of what the environment draws once and keeps over all episodes, if
    /// anything.
    ///
    /// # Errors
    /// The name is none of [`Self::names`], or the environment cannot be made.
    fn make(&self, name: &str, environment_seed: u64) -> Result<Box<dyn Environment>, EnvironmentError>;
}

/// Why an environment is missing or failed.
#[derive(Debug, Error)]
pub enum EnvironmentError {
    /// The name is known to the dataset crate, but this evaluator has no simulation of it.
    #[error("this evaluator cannot simulate the environment \"{0}\"")]
    NotSimulated(String),
    /// The environment gave an observation of another size than the policy takes.
    #[error("an observation has {found} numbers, but the policy takes {wanted}")]
    Observation {
        /// Size of the observation.
        found: usize,
        /// Size that the policy takes.
        wanted: usize,
    },
    /// The environment failed, with its own message.
    #[error("the environment \"{name}\" failed: {reason}")]
    Failed {
        /// The environment.
        name: String,
        /// The message.
        reason: String,
    },
    /// MuJoCo refused the embedded model: the library is not the version that this program was built for.
    #[error("MuJoCo could not compile the model of \"{simulation}\": {reason}")]
    Model {
        /// Name of the simulation whose model it is.
        simulation: &'static str,
        /// MuJoCo's error message.
        reason: String,
    },
    /// MuJoCo could not allocate the state of a simulation.
    #[error("MuJoCo could not allocate the state of a simulation: {0}")]
    Allocation(String),
}
