//! A policy that is asked in its user's units, though its networks have learned in their own.

use crate::error::PolicyError;
use crate::policy::{Policy, Sampled};
use crate::sampling::choice::Choice;
use crate::sampling::episode::EpisodeState;
use quad_kernels::scaling::{Affine, Scaling};
use quad_nn::{Precision, bytes};
use std::borrow::Cow;
use std::sync::Arc;

/// Scales what goes in, and what comes out back.
struct Scaled {
    /// The policy, in the network's units.
    policy: Box<dyn Policy>,
    scaling: Arc<Scaling>,
}

/// The policy in the units that its file says.
pub(crate) fn scaled(
    policy: Box<dyn Policy>,
    scaling: Option<Scaling>,
) -> Result<Box<dyn Policy>, PolicyError> {
    let Some(scaling) = scaling else { return Ok(policy) };
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

/// The numbers as the network has them.
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

    fn with_choice(&self, choice: Choice) -> Result<Box<dyn Policy>, PolicyError> {
        Ok(Box::new(Self {
            policy: self.policy.with_choice(choice)?,
            scaling: self.scaling.clone(),
        }))
    }

    fn memory(&self, states: usize) -> u64 {
        let observations = states as u128 * self.observation_dim() as u128;
        self.policy.memory(states).saturating_add(bytes(observations))
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
    ) -> Result<(), PolicyError> {
        self.policy.act(&self.observations(observations), states, actions)?;
        self.to_user(actions);
        Ok(())
    }

    fn sample(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
    ) -> Result<Sampled, PolicyError> {
        let mut sampled = self.policy.sample(&self.observations(observations), states)?;
        self.to_user(&mut sampled.actions);
        Ok(sampled)
    }

    fn value(&self, observations: &[f32], actions: &[f32]) -> Result<Vec<f32>, PolicyError> {
        let actions = to_network(self.scaling.actions.as_ref(), actions);
        self.policy.value(&self.observations(observations), &actions)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::file::{Header, load_policy};
    use crate::golden::file_of;

    fn affine(offset: &[f32], scale: &[f32]) -> Option<Affine> {
        Some(Affine { offset: offset.to_vec(), scale: scale.to_vec() })
    }

    fn scaling() -> Scaling {
        Scaling {
            observations: affine(&[100.0, -3.0, 0.5, 0.0], &[8.0, 0.5, 1.0, 4.0]),
            actions: affine(&[30.0, -1.0], &[16.0, 0.25]),
            rewards: None,
        }
    }

    /// One policy, without and with maps.
    fn pair(scaling: Scaling) -> [Result<Box<dyn Policy>, PolicyError>; 2] {
        let load =
            |scaling| load_policy(&file_of(Choice::best_of(6), 1.0, None, scaling), Precision::F32);
        [load(None), load(Some(scaling))]
    }

    #[test]
    fn the_user_s_units_go_in_and_come_out() {
        let [plain, scaled] = pair(scaling()).map(Result::unwrap);
        // (108, -2.5, 1.5, -4) is (1, 1, 1, -1) to the networks, (100, -3, 0.5, 8) is (0, 0, 0, 2):
        // all without rounding.
        let (ours, theirs) = (
            [1.0, 1.0, 1.0, -1.0, 0.0, 0.0, 0.0, 2.0],
            [108.0, -2.5, 1.5, -4.0, 100.0, -3.0, 0.5, 8.0],
        );
        let begin = || [4, 5].map(|seed| plain.begin(seed));
        let to_user = |actions: &[f32]| -> Vec<f32> {
            actions.chunks_exact(2).flat_map(|a| [30.0 + 16.0 * a[0], -1.0 + 0.25 * a[1]]).collect()
        };
        let act = |policy: &dyn Policy, observations: &[f32]| {
            let mut actions = vec![0.0; 4];
            policy.act(observations, &mut begin(), &mut actions).unwrap();
            actions
        };
        let acted = act(&*scaled, &theirs);
        let close = |a: &[f32], b: &[f32]| {
            a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5) && a.len() == b.len()
        };
        assert!(close(&acted, &to_user(&act(&*plain, &ours))), "{acted:?}");
        let inside = |a: &[f32]| (14.0..=46.0).contains(&a[0]) && (-1.25..=-0.75).contains(&a[1]);
        let (plainly, sampled) = (
            plain.sample(&ours, &mut begin()).unwrap(),
            scaled.sample(&theirs, &mut begin()).unwrap(),
        );
        assert!(sampled.actions.chunks_exact(2).all(inside), "{:?}", sampled.actions);
        assert!(close(&sampled.actions, &to_user(&plainly.actions)));
        assert_eq!(sampled.values, plainly.values);
        assert!(sampled.actions[..12].chunks_exact(2).any(|action| action == &acted[..2]));

        let value = scaled.value(&theirs, &[38.0, -1.125, 22.0, -0.75]).unwrap();
        assert_eq!(value, plain.value(&ours, &[0.5, -0.5, -0.5, 1.0]).unwrap());
        assert_ne!(value, plain.value(&theirs, &[38.0, -1.125, 22.0, -0.75]).unwrap());

        let of_one = scaled.with_choice(Choice::best_of(1)).unwrap();
        assert_eq!(
            act(&*of_one, &theirs),
            to_user(&act(&*plain.with_choice(Choice::best_of(1)).unwrap(), &ours))
        );
        assert!(scaled.memory(3) > plain.memory(3));
        assert_eq!((scaled.noise(), scaled.choice()), (vec![2, 6, 2], plain.choice()));
    }

    #[test]
    fn a_number_that_never_changed_is_given_exactly_and_not_seen() {
        let observations = affine(&[100.0, -3.0, 0.1, 0.0], &[8.0, 0.5, 0.0, 4.0]);
        let constant = Scaling {
            observations,
            actions: affine(&[30.0, 0.1], &[16.0, 0.0]),
            rewards: Some(200.0),
        };
        let [plain, scaled] = pair(constant).map(Result::unwrap);
        let begin = || [plain.begin(4)];
        let mut acted = [vec![0.0; 2], vec![0.0; 2]];
        for (third, actions) in [0.1, 90.0].into_iter().zip(&mut acted) {
            scaled.act(&[108.0, -2.5, third, -4.0], &mut begin(), actions).unwrap();
        }
        assert_eq!(acted[0], acted[1]);
        assert_eq!(acted[0][1], 0.1);
        let sampled = scaled.sample(&[108.0, -2.5, 0.1, -4.0], &mut begin()).unwrap();
        assert!(sampled.actions.chunks_exact(2).all(|action| action[1] == 0.1));
        let mut ours = vec![0.0; 2];
        plain.act(&[1.0, 1.0, 0.0, -1.0], &mut begin(), &mut ours).unwrap();
        assert!(
            (acted[0][0] - (30.0 + 16.0 * ours[0])).abs() < 1e-5 && ours[1] != 0.0,
            "{acted:?} {ours:?}"
        );
        let value = scaled.value(&[108.0, -2.5, 0.1, -4.0], &[38.0, 0.1]).unwrap();
        assert_eq!(value, plain.value(&[1.0, 1.0, 0.0, -1.0], &[0.5, 0.0]).unwrap());
    }

    #[test]
    fn a_map_that_does_not_fit_is_refused() {
        let good = scaling();
        let refused = |scaling| matches!(&pair(scaling)[1], Err(PolicyError::Scaling { .. }));
        assert!(!refused(good.clone()) && !refused(Scaling { observations: None, ..good.clone() }));
        assert!(refused(Scaling { observations: affine(&[0.0; 3], &[1.0; 3]), ..good.clone() }));
        assert!(refused(Scaling { actions: affine(&[0.0; 2], &[1.0, -1.0]), ..good.clone() }));
        assert!(refused(Scaling { actions: affine(&[0.0; 2], &[1.0]), ..good }));
    }

    #[test]
    fn a_file_says_nothing_of_scaling_where_there_is_none() {
        let header = |scaling| {
            let file = file_of(Choice::best_of(1), 1.0, None, scaling);
            serde_json::to_value(Header::<()>::read(&file).unwrap()).unwrap()
        };
        assert!(header(None).get("scaling").is_none());
        let written = header(Some(Scaling { observations: None, ..scaling() }));
        let expected =
            serde_json::json!({ "actions": { "offset": [30.0, -1.0], "scale": [16.0, 0.25] } });
        assert_eq!(written["scaling"], expected);
    }
}
