//! What any policy can do, whatever its kind.

use crate::error::PolicyError;
use crate::sampling::choice::Choice;
use crate::sampling::episode::EpisodeState;
use quad_nn::Precision;

/// A trained policy, ready to act.
pub trait Policy: Send + Sync {
    /// Numbers in an observation.
    fn observation_dim(&self) -> usize;

    /// Numbers in an action.
    fn action_dim(&self) -> usize;

    /// The precision that its actions are computed in, which need not be the one that was asked
    /// for.
    fn precision(&self) -> Precision;

    /// How it chooses among the actions that it draws; none if it draws none.
    fn choice(&self) -> Option<Choice> {
        None
    }

    /// Makes a policy that chooses in another way, by the same networks in the same memory. This
    /// one stays as it is.
    ///
    /// # Errors
    /// It draws no actions, it lacks a network that this takes, or a number is out of range.
    fn with_choice(&self, _choice: Choice) -> Result<Box<dyn Policy>, PolicyError> {
        Err(PolicyError::NoCandidates)
    }

    /// Memory beside the weights that one call of [`Self::act`] takes for so many states at most,
    /// bytes. It can be asked before it is too much.
    fn memory(&self, states: usize) -> u64;

    /// What it carries through the episode of that seed, at its beginning.
    fn begin(&self, seed: u64) -> EpisodeState {
        EpisodeState::new(seed)
    }

    /// The shape of the standard normal numbers that [`Self::act`] draws in a state of an episode
    /// that begins; empty if it draws none. [`Choice::uniforms`] says how many uniform ones follow.
    fn noise(&self) -> Vec<usize> {
        Vec::new()
    }

    /// Acts in each of n states.
    ///
    /// `observations` is `n × observation_dim`, `actions` (written) `n × action_dim`; `states` has
    /// what the policy carries through each state's episode.
    ///
    /// # Errors
    /// An action or its value is not a number, or candle fails.
    fn act(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<(), PolicyError>;

    /// Draws the actions that [`Self::act`] would choose among in each of n states, and says what
    /// the critics give each.
    ///
    /// `observations` is `n × observation_dim`, n at least 1; `states` has what the policy carries
    /// through each state's episode. From equal states, [`Self::act`] takes one of these actions,
    /// or the mean of some.
    ///
    /// # Errors
    /// It has no critics, an action or its value is not a number, or candle fails.
    fn sample(
        &self,
        _observations: &[f32],
        _states: &mut [EpisodeState],
    ) -> Result<Sampled, PolicyError> {
        Err(PolicyError::NoCritics)
    }

    /// What the critics say of n actions, each in a state of its own: n numbers, by the choice's
    /// [`Aggregate`](crate::Aggregate), in units of the return that they were trained for.
    ///
    /// `observations` is `n × observation_dim`, `actions` `n × action_dim`, n at least 1.
    ///
    /// # Errors
    /// It has no critics, a value is not a number, the lengths do not fit, or candle fails.
    fn value(&self, _observations: &[f32], _actions: &[f32]) -> Result<Vec<f32>, PolicyError> {
        Err(PolicyError::NoCritics)
    }
}

/// What a policy has drawn in n states.
#[derive(Clone, Debug, PartialEq)]
pub struct Sampled {
    /// The actions, `n × candidates × action_dim`, in the order in which they were drawn.
    pub actions: Vec<f32>,
    /// The value of each action, `n × candidates`, by the choice's [`Aggregate`](crate::Aggregate).
    pub values: Vec<f32>,
}
