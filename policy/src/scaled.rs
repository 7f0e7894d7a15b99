//! A policy in the user's units.

use crate::error::{PolicyError, Result};
use crate::policy::{Policy, Samples};
use crate::sampling::choice::Choice;
use crate::sampling::episode::EpisodeState;
use quad_kernels::scaling::{Affine, Scaling};
use quad_nn::{Precision, f32_bytes};
use std::borrow::Cow;
use std::sync::Arc;

struct Scaled {
    /// The policy in the networks' units.
    policy: Box<dyn Policy>,
    scaling: Arc<Scaling>,
}

/// The policy in the user's units.
pub(crate) fn scaled(policy: Box<dyn Policy>, scaling: Scaling) -> Result<Box<dyn Policy>> {
    for (what, affine, columns) in [
        ("observations", &scaling.observations, policy.observation_dim()),
        ("actions", &scaling.actions, policy.action_dim()),
    ] {
        if affine.as_ref().is_some_and(|affine| !affine.is_usable(columns)) {
            return Err(PolicyError::Scaling { what, columns });
        }
    }
    Ok(Box::new(Scaled { policy, scaling: Arc::new(scaling) }))
}

fn to_network<'a>(affine: Option<&Affine>, numbers: &'a [f32]) -> Cow<'a, [f32]> {
    let Some(affine) = affine else { return numbers.into() };
    let mut numbers = numbers.to_vec();
    affine.to_network(&mut numbers);
    numbers.into()
}

impl Scaled {
    fn observations<'a>(&self, observations: &'a [f32]) -> Cow<'a, [f32]> {
        to_network(self.scaling.observations.as_ref(), observations)
    }

    fn to_user(&self, actions: &mut [f32]) {
        if let Some(affine) = &self.scaling.actions {
            affine.to_user(actions);
        }
    }
}

impl Policy for Scaled {
    fn observation_dim(&self) -> usize {
        self.policy.observation_dim()
    }

    fn action_dim(&self) -> usize {
        self.policy.action_dim()
    }

    fn precision(&self) -> Precision {
        self.policy.precision()
    }

    fn choice(&self) -> Option<Choice> {
        self.policy.choice()
    }

    fn with_choice(&self, choice: Choice) -> Result<Box<dyn Policy>> {
        let policy = self.policy.with_choice(choice)?;
        Ok(Box::new(Self { policy, scaling: self.scaling.clone() }))
    }

    fn memory(&self, states: usize) -> u64 {
        let observations = states as u128 * self.observation_dim() as u128;
        self.policy.memory(states).saturating_add(f32_bytes(observations))
    }

    fn observe(&self, observations: &[f32], states: &mut [EpisodeState]) {
        self.policy.observe(&self.observations(observations), states);
    }

    fn begin(&self, seed: u64) -> EpisodeState {
        self.policy.begin(seed)
    }

    fn noise(&self) -> Vec<usize> {
        self.policy.noise()
    }

    fn act(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<()> {
        self.policy.act(&self.observations(observations), states, actions)?;
        self.to_user(actions);
        Ok(())
    }

    fn explore(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<()> {
        self.policy.explore(&self.observations(observations), states, actions)?;
        self.to_user(actions);
        Ok(())
    }

    fn change_actions(&self, actions: &mut [f32], change: &mut dyn FnMut(&mut [f32])) {
        if let Some(affine) = &self.scaling.actions {
            affine.to_network(actions);
        }
        self.policy.change_actions(actions, change);
        self.to_user(actions);
    }

    fn sample(&self, observations: &[f32], states: &mut [EpisodeState]) -> Result<Samples> {
        let mut samples = self.policy.sample(&self.observations(observations), states)?;
        self.to_user(&mut samples.actions);
        Ok(samples)
    }

    fn value(&self, observations: &[f32], actions: &[f32]) -> Result<Vec<f32>> {
        let actions = to_network(self.scaling.actions.as_ref(), actions);
        self.policy.value(&self.observations(observations), &actions)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{act, diffusion_file, load, sample};

    fn affine(offset: &[f32], scale: &[f32]) -> Option<Affine> {
        Some(Affine { offset: offset.to_vec(), scale: scale.to_vec() })
    }

    /// One policy in the networks' and in the user's units.
    fn pair(scaling: Scaling) -> [Result<Box<dyn Policy>>; 2] {
        [None, Some(scaling)]
            .map(|scaling| load(&diffusion_file(Choice::best_of(6), 1.0, None, scaling)))
    }

    fn assert_close(x: &[f32], y: &[f32]) {
        assert_eq!(x.len(), y.len());
        assert!(x.iter().zip(y).all(|(x, y)| (x - y).abs() < 1e-5), "{x:?} {y:?}");
    }

    #[test]
    fn observations_and_actions_are_converted() {
        let observations = affine(&[100.0, -3.0, 0.5, 0.0], &[8.0, 0.5, 1.0, 4.0]);
        let actions = affine(&[30.0, -1.0], &[16.0, 0.25]);
        let scaling = Scaling { observations, actions, rewards: None };
        let [plain, scaled] = pair(scaling).map(Result::unwrap);
        // The same numbers in both units, without rounding.
        let ours = [1.0, 1.0, 1.0, -1.0, 0.0, 0.0, 0.0, 2.0];
        let users = [108.0, -2.5, 1.5, -4.0, 100.0, -3.0, 0.5, 8.0];
        let user = |a: &[f32]| [30.0 + 16.0 * a[0], -1.0 + 0.25 * a[1]];
        let to_user =
            |actions: &[f32]| -> Vec<f32> { actions.chunks_exact(2).flat_map(user).collect() };
        let act = |policy: &dyn Policy, observations| act(policy, observations, &[4, 5]).unwrap();
        let taken = act(&*scaled, &users);
        assert_close(&taken, &to_user(&act(&*plain, &ours)));
        let explored = |policy: &dyn Policy, observations| {
            let mut actions = [0.0; 4];
            let mut states = [4, 5].map(|seed| policy.begin(seed));
            policy.explore(observations, &mut states, &mut actions).unwrap();
            actions
        };
        assert_close(&explored(&*scaled, &users), &to_user(&explored(&*plain, &ours)));
        let expected = sample(&*plain, &ours, &[4, 5]).unwrap();
        let samples = sample(&*scaled, &users, &[4, 5]).unwrap();
        assert_close(&samples.actions, &to_user(&expected.actions));
        assert_eq!(samples.values, expected.values);
        assert!(samples.actions[..12].chunks_exact(2).any(|action| action == &taken[..2]));

        let value = scaled.value(&users, &[38.0, -1.125, 22.0, -0.75]).unwrap();
        assert_eq!(value, plain.value(&ours, &[0.5, -0.5, -0.5, 1.0]).unwrap());
        let of_one = |policy: &dyn Policy| policy.with_choice(Choice::best_of(1)).unwrap();
        let ours = act(&*of_one(&*plain), &ours);
        assert_close(&act(&*of_one(&*scaled), &users), &to_user(&ours));
        let mut changed = [38.0, -1.125, 22.0, -0.75];
        scaled.change_actions(&mut changed, &mut |actions| {
            assert_eq!(actions, [0.5, -0.5, -0.5, 1.0]);
            actions.fill(-1.0);
        });
        assert_eq!(changed, [14.0, -1.25, 14.0, -1.25]);
        assert!(scaled.memory(3) > plain.memory(3));
        assert_eq!((scaled.noise(), scaled.choice()), (vec![2, 6, 2], plain.choice()));
    }

    #[test]
    fn a_constant_number_is_returned_exactly_and_not_seen() {
        let observations = affine(&[100.0, -3.0, 0.1, 0.0], &[8.0, 0.5, 0.0, 4.0]);
        let actions = affine(&[30.0, 0.1], &[16.0, 0.0]);
        let scaling = Scaling { observations, actions, rewards: Some(200.0) };
        let [plain, scaled] = pair(scaling).map(Result::unwrap);
        let (ours, users) = ([1.0, 1.0, 0.0, -1.0], [108.0, -2.5, 0.1, -4.0]);
        let action = act(&*scaled, &users, &[4]).unwrap();
        let other = [108.0, -2.5, 90.0, -4.0];
        assert_eq!(action, act(&*scaled, &other, &[4]).unwrap());
        let expected = act(&*plain, &ours, &[4]).unwrap();
        assert_close(&action, &[30.0 + 16.0 * expected[0], 0.1]);
        let samples = sample(&*scaled, &users, &[4]).unwrap();
        assert!(samples.actions.chunks_exact(2).all(|a| a[1] == 0.1));
        let value = scaled.value(&users, &[38.0, 0.1]).unwrap();
        assert_eq!(value, plain.value(&ours, &[0.5, 0.0]).unwrap());
    }

    #[test]
    fn a_scaling_that_does_not_fit_is_refused() {
        let good = affine(&[0.0; 2], &[1.0; 2]);
        for (observations, actions, expected) in [
            (None, good.clone(), false),
            (affine(&[0.0; 4], &[1.0; 4]), good.clone(), false),
            (affine(&[0.0; 3], &[1.0; 3]), good, true),
            (None, affine(&[0.0; 2], &[1.0, -1.0]), true),
            (None, affine(&[0.0; 2], &[1.0]), true),
        ] {
            let [_, scaled] = pair(Scaling { observations, actions, rewards: None });
            let refused = matches!(scaled, Err(PolicyError::Scaling { .. }));
            assert_eq!(refused, expected);
        }
    }
}
