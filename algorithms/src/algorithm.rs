//! An algorithm in the middle of a run: its update, the policy to publish, its state as one list of
//! named parts, and its errors.

use candle_core::{Result, Tensor};
use quad_nn::Tensors;
use quad_policy::{PolicyConfig, PolicyError};

use super::parts::Parts;

/// What an update measured, by the names in the algorithm's table of metrics.
pub type Measured = Vec<(&'static str, f32)>;

/// An algorithm in the middle of a run.
pub trait Algorithm: Send {
    /// How many items updates draw from, of a dataset with so many transitions: these, unless it
    /// says otherwise.
    fn items(&self, transitions: usize) -> usize {
        transitions
    }

    /// The steps at which phases begin whose updates take another time than those before; one
    /// phase, unless it says otherwise.
    fn phases(&self) -> Vec<u64> {
        vec![0]
    }

    /// Update number `step`, from 0, on the items of these numbers; its random numbers are a
    /// function of the run's seed and of `step`.
    ///
    /// # Errors
    /// Candle fails.
    fn update(&mut self, step: u64, items: &[u32]) -> Result<Measured>;

    /// What update number `step` would measure on the items of these numbers if no network moved:
    /// its losses with the weights as they are. Nothing is changed.
    ///
    /// # Errors
    /// Candle fails.
    fn evaluate(&self, step: u64, items: &[u32]) -> Result<Measured>;

    /// The policy to be evaluated: what it is, and its tensors.
    ///
    /// # Errors
    /// Candle fails.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)>;

    /// Everything that updates change, by name: with the step it decides the future of the run.
    /// Saving and loading go by it.
    fn parts(&mut self) -> Parts<'_>;
}

/// Why an algorithm cannot start or be saved.
#[derive(Debug, thiserror::Error)]
pub enum AlgorithmError {
    /// The policy or the state does not hold what it should.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// Its hyper-parameters cannot be used.
    #[error(transparent)]
    Agent(#[from] AgentError),
    /// The dataset has nothing that the algorithm learns from.
    #[error("no transition of the dataset has a next action, which this algorithm learns from")]
    NoNextAction,
    /// The dataset has no episode that the algorithm learns from.
    #[error("no episode of the dataset has {0} transitions (agent.shortest_episode)")]
    ShortEpisodes(usize),
    /// The dataset has no window of this many transitions to learn from.
    #[error(
        "no episode of the dataset has {0} transitions, which this algorithm plans ahead, and none terminates"
    )]
    NoWindow(usize),
    /// A tensor cannot be computed or moved.
    #[error("candle failed")]
    Candle(#[from] candle_core::Error),
}

impl AlgorithmError {
    /// What the user can do about it.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::NoNextAction => {
                "a transition has one if the next row of the file continues its episode: `learner datasets inspect` says how long \
                 episodes are; other algorithms learn from single transitions (--algorithm iql, say)"
            }
            Self::ShortEpisodes(_) => {
                "`learner datasets inspect` says how long episodes are; --agent shortest_episode=1 keeps them all"
            }
            Self::NoWindow(_) => {
                "a shorter horizon (--agent network.horizon=4, say), or longer episodes"
            }
            Self::Policy(_) | Self::Agent(_) | Self::Candle(_) => {
                "`learner presets TASK` prints hyper-parameters that work; smaller networks and batches take less memory"
            }
        }
    }
}

/// Hyper-parameters that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum AgentError {
    /// One too many, one too few, or of the wrong type.
    #[error("[agent]: {0}")]
    Parse(#[from] toml::de::Error),
    /// One is outside its range.
    #[error("agent.{field} is {value}, but must be {range}")]
    Range {
        /// Name within the `[agent]` table.
        field: &'static str,
        /// The value that was given.
        value: String,
        /// The values that are allowed.
        range: &'static str,
    },
}

/// Checks that a hyper-parameter is in its range.
pub(super) fn check(
    field: &'static str,
    value: impl ToString,
    holds: bool,
    range: &'static str,
) -> std::result::Result<(), AgentError> {
    if holds { Ok(()) } else { Err(AgentError::Range { field, value: value.to_string(), range }) }
}

/// The smaller of the critics' values, `[K, B]` → `[B]`. (`min` ignores NaN; adding 0·sum keeps
/// it.)
pub(super) fn smaller(values: &Tensor) -> Result<Tensor> {
    values.min(0)? + (values.sum(0)? * 0.0)?
}

/// The largest along a dimension, which it removes. (`max` ignores NaN; adding 0·sum keeps it.)
pub(super) fn largest(values: &Tensor, dimension: usize) -> Result<Tensor> {
    values.max(dimension)? + (values.sum(dimension)? * 0.0)?
}

/// A loss `[]` that a network is moved down, and the scalars `[]` that are measured with it.
pub(super) struct Loss {
    pub value: Tensor,
    /// By the names of metrics, the loss first.
    scalars: Vec<(&'static str, Tensor)>,
}

impl Loss {
    /// A loss that is the metric of this name.
    pub fn new(name: &'static str, value: Tensor) -> Self {
        Self { scalars: vec![(name, value.clone())], value }
    }

    /// Also measures this scalar `[]` or `[1]`, if there is one.
    pub fn with(mut self, name: &'static str, scalar: impl Into<Option<Tensor>>) -> Self {
        self.scalars.extend(scalar.into().map(|scalar| (name, scalar)));
        self
    }
}

/// The scalars of some losses.
pub(super) fn scalars(losses: &[Loss]) -> impl Iterator<Item = &(&'static str, Tensor)> {
    losses.iter().flat_map(|loss| &loss.scalars)
}

/// What some losses measure; from a GPU in one copy, because each copy waits for the GPU.
pub(super) fn measured(losses: &[Loss]) -> Result<Measured> {
    let values = joined(&Vec::from_iter(scalars(losses).map(|(_, scalar)| scalar)))?.to_vec1()?;
    Ok(scalars(losses).map(|(name, _)| *name).zip(values).collect())
}

/// The numbers of some tensors, one tensor after the other, `[n]`.
pub(super) fn joined(x: &[&Tensor]) -> Result<Tensor> {
    Tensor::cat(&x.iter().map(|x| x.flatten_all()).collect::<Result<Vec<_>>>()?, 0)
}
