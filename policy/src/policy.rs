//! The trait of all policies.

use crate::error::{PolicyError, Result};
use crate::sampling::choice::Choice;
use crate::sampling::episode::EpisodeState;
use quad_nn::Precision;

/// A trained policy, ready to act.
///
/// Methods for n states take `observations`, `n × observation_dim`, and the `states` of the policy
/// in their episodes.
pub trait Policy: Send + Sync {
    /// Length of an observation.
    fn observation_dim(&self) -> usize;

    /// Length of an action.
    fn action_dim(&self) -> usize;

    /// The precision in effect, which can differ from the requested one.
    fn precision(&self) -> Precision;

    /// The choice among candidates; `None` if the policy draws none.
    fn choice(&self) -> Option<Choice> {
        None
    }

    /// The same networks, in the same memory, with another choice.
    ///
    /// # Errors
    /// The policy draws no candidates, it lacks a value function, or a number is out of range.
    fn with_choice(&self, _choice: Choice) -> Result<Box<dyn Policy>> {
        Err(PolicyError::NoCandidates)
    }

    /// Upper bound of the memory that [`Self::act`] takes for this many states, bytes.
    fn memory(&self, states: usize) -> u64;

    /// The state at the beginning of an episode with this seed.
    fn begin(&self, seed: u64) -> EpisodeState {
        EpisodeState::new(seed)
    }

    /// Takes note of observations in which it does not act, if it sees several at a time.
    fn observe(&self, _observations: &[f32], _states: &mut [EpisodeState]) {}

    /// Shape of the standard normal numbers that [`Self::act`] draws in the first state of an
    /// episode; empty if it draws none. [`Choice::uniforms`] uniform numbers follow.
    fn noise(&self) -> Vec<usize> {
        Vec::new()
    }

    /// Acts in n states, writing `actions`, `n × action_dim`.
    ///
    /// # Errors
    /// An action or its value is NaN.
    fn act(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<()>;

    /// Acts as [`Self::act`], but draws from the policy's distribution where that takes its mode.
    ///
    /// # Errors
    /// As [`Self::act`].
    fn explore(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<(), PolicyError> {
        self.act(observations, states, actions)
    }

    /// Changes actions, `n × action_dim`, in units in which they are within ±1.
    fn change_actions(&self, actions: &mut [f32], change: &mut dyn FnMut(&mut [f32])) {
        change(actions);
    }

    /// Draws the candidates of n ≥ 1 states and their values. From equal states, [`Self::act`] takes
    /// one of these candidates, or the mean of some.
    ///
    /// # Errors
    /// The policy has no critics, or an action or its value is NaN.
    fn sample(&self, _observations: &[f32], _states: &mut [EpisodeState]) -> Result<Samples> {
        Err(PolicyError::NoCritics)
    }

    /// The critics' values of n ≥ 1 actions, `n × action_dim`, each in its own state, by the choice's
    /// [`Aggregate`](crate::Aggregate), in units of the return that they were trained for.
    ///
    /// # Errors
    /// The policy has no critics, the lengths do not fit, or a value is NaN.
    fn value(&self, _observations: &[f32], _actions: &[f32]) -> Result<Vec<f32>> {
        Err(PolicyError::NoCritics)
    }
}

/// Candidates of n states.
#[derive(Clone, Debug, PartialEq)]
pub struct Samples {
    /// Actions, `n × candidates × action_dim`, in the order of their drawing.
    pub actions: Vec<f32>,
    /// Values, `n × candidates`, by the choice's [`Aggregate`](crate::Aggregate).
    pub values: Vec<f32>,
}
