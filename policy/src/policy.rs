//! What any policy can do, whatever its kind.

use crate::choice::Choice;
use crate::episode::EpisodeState;
use crate::error::PolicyError;
use crate::precision::Precision;

/// A trained policy, ready to act.
pub trait Policy: Send + Sync {
    /// Numbers in an observation.
    fn observation_dim(&self) -> usize;

    /// Numbers in an action.
    fn action_dim(&self) -> usize;

    /// The precision that its actions are computed in, which need not be the one that was asked for.
    fn precision(&self) -> Precision;

    /// How it chooses among the actions that it draws; none if it draws none.
    fn choice(&self) -> Option<Choice> {
        None
    }

    /// Lets it choose in another way.
    ///
    /// # Errors
    /// It draws no actions, it lacks a network that this takes, or a number is out of range.
    fn choose(&mut self, _choice: Choice) -> Result<(), PolicyError> {
        Err(PolicyError::NoCandidates)
    }

    /// Memory beside the weights that one call of [`Self::act`] takes for so many states at most, bytes. It can be asked
    /// before it is too much.
    fn memory(&self, states: usize) -> u64;

    /// What it carries through the episode of that seed, at its beginning.
    fn begin(&self, seed: u64) -> EpisodeState {
        EpisodeState::new(seed)
    }

    /// Acts in each of n states.
    ///
    /// `observations` is `n × observation_dim`, `actions` (written) `n × action_dim`; `states` has what the policy carries
    /// through each state's episode.
    ///
    /// # Errors
    /// An action or its value is not a number, or candle fails.
    fn act(&self, observations: &[f32], states: &mut [EpisodeState], actions: &mut [f32]) -> Result<(), PolicyError>;
}
