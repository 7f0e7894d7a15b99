//! The interface between a policy and an environment, in this program or in another language.

use quad_protocol::EpisodeScore;
use thiserror::Error;

/// The result of one step of an environment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Step {
    pub reward: f64,
    /// The task ended the episode: there is no future to bootstrap from.
    pub terminated: bool,
    /// The time limit was reached. As in Gymnasium, `terminated` may be true, too.
    pub truncated: bool,
    /// The action that a person took in place of the given one, as long as that.
    pub intervention: Option<Vec<f32>>,
    /// The given action within the environment's limits, if it lies beyond them.
    pub clipped: Option<Vec<f32>>,
}

pub trait Environment: Send {
    fn name(&self) -> &str;

    /// Says before [`reset`](Self::reset) that the episode is online, in which a person may act.
    fn allow_interventions(&mut self) {}

    /// Starts an episode, which is a function of its seed and its actions only.
    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError>;

    /// Applies an action for one control period.
    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError>;

    fn observation(&self) -> &[f64];

    /// Scores the ended episode by the undiscounted sum of its rewards.
    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError>;
}

/// Makes environments for an evaluator.
pub trait Environments: Send + Sync {
    /// The names that learners may ask for.
    fn names(&self) -> Vec<String>;

    /// Sizes of an observation and of an action, if they are known before an environment exists.
    fn sizes(&self, name: &str) -> Option<(usize, usize)>;

    /// Makes an environment of one of [`Self::names`]. `environment_seed` decides what it draws
    /// once for all episodes, if anything.
    fn make(
        &self,
        name: &str,
        environment_seed: u64,
    ) -> Result<Box<dyn Environment>, EnvironmentError>;
}

/// Failure to make an environment, or of an environment.
#[derive(Debug, Error)]
pub enum EnvironmentError {
    #[error("this evaluator cannot simulate the environment \"{0}\"")]
    NotSimulated(String),
    #[error("an observation has {size} numbers, but the policy takes {expected}")]
    Observation { size: usize, expected: usize },
    #[error("the environment \"{name}\" failed: {reason}")]
    Failed { name: String, reason: String },
    #[error(
        "a person took an action in the evaluation episode with seed {0}, whose score is to be the policy's: in online episodes alone, \
         `reset` gets options={{\"online\": True}}"
    )]
    Intervention(u64),
    #[error(
        "the environment \"{name}\" gave {array}[{index}] = {value} after step {step} of the episode with seed {seed}: does its \
         simulation diverge, or a sensor fail?"
    )]
    Unusable {
        name: String,
        array: &'static str,
        index: usize,
        value: f64,
        /// Steps before it; 0 after a reset.
        step: u32,
        seed: u64,
    },
    /// No learner would count the episode.
    #[error(
        "the {what} of the episode with seed {seed} is {value} after {length} steps, not a finite number up to {:e}",
        EpisodeScore::LARGEST
    )]
    NotCounted { what: &'static str, seed: u64, value: f64, length: u32 },
    /// The library is not the version that this program was built for.
    #[error("MuJoCo could not compile the model of \"{simulation}\": {reason}")]
    Model { simulation: &'static str, reason: String },
    #[error("MuJoCo could not allocate the state of a simulation: {0}")]
    Allocation(String),
}
