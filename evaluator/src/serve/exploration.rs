//! Actions of online episodes.

use quad_policy::{EpisodeState, Policy, PolicyError};
use quad_protocol::Exploration;

/// Fills in the actions of n states of an online episode, `n × action_dim`, for `observations`,
/// `n × observation_dim`. An action depends on the state and the observation of its own episode.
pub fn explore(
    rule: Exploration,
    policy: &dyn Policy,
    observations: &[f32],
    states: &mut [EpisodeState],
    actions: &mut [f32],
) -> Result<(), PolicyError> {
    match rule {
        Exploration::Uniform => {
            policy.change_actions(actions, &mut |actions| draw_uniform(states, actions));
        }
        Exploration::Policy { noise } => {
            policy.explore(observations, states, actions)?;
            if noise > 0.0 {
                policy.change_actions(actions, &mut |actions| add_noise(noise, states, actions));
            }
        }
    }
    Ok(())
}

/// Fills in actions of n states, `n × action_dim`, drawn uniformly within ±1.
pub fn draw_uniform(states: &mut [EpisodeState], actions: &mut [f32]) {
    let width = actions.len() / states.len();
    for (action, state) in actions.chunks_exact_mut(width).zip(states) {
        action.fill_with(|| (2.0 * state.uniform() - 1.0) as f32);
    }
}

/// Adds normal noise of this standard deviation to actions of n states, then clips them to ±1.
pub fn add_noise(std: f32, states: &mut [EpisodeState], actions: &mut [f32]) {
    let mut normal = vec![0.0; actions.len() / states.len()];
    for (action, state) in actions.chunks_exact_mut(normal.len()).zip(states) {
        state.fill_normal(&mut normal);
        for (x, z) in action.iter_mut().zip(&normal) {
            *x = (*x + std * z).clamp(-1.0, 1.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device, Tensor};
    use quad_nn::Layout;
    use quad_policy::{Header, MlpConfig, PolicyConfig, Precision, Scaling, Spread, load_policy};
    use serde_json::json;

    use super::*;

    /// A policy whose mode is 0 in the network's units; σ is 1, unless there is no spread.
    fn policy(spread: Spread, scaling: Option<Scaling>) -> Box<dyn Policy> {
        let actor = MlpConfig::mish(&[1]);
        let shape =
            json!({"observation_dim": 1, "action_dim": 2, "actor": actor, "spread": spread});
        let policy = json!({"kind": "gaussian", "shape": shape});
        let policy: PolicyConfig = serde_json::from_value(policy).unwrap();
        let zeros = |layout: &Layout| Tensor::zeros(layout.count(), DType::F32, &Device::Cpu);
        let tensors = policy.tensors(zeros).unwrap();
        let file = Header { scaling, ..Header::new(policy, ()) }.to_safetensors(&tensors);
        load_policy(&file.unwrap(), Precision::F32).unwrap()
    }

    /// The actions of two steps of each episode, one episode after the other.
    fn actions(rule: Exploration, policy: &dyn Policy, seeds: &[u64]) -> Vec<f32> {
        let mut states: Vec<_> = seeds.iter().map(|seed| policy.begin(*seed)).collect();
        let mut steps = [vec![7.0; 2 * seeds.len()], vec![7.0; 2 * seeds.len()]];
        for actions in &mut steps {
            explore(rule, policy, &vec![0.5; seeds.len()], &mut states, actions).unwrap();
        }
        let [first, second] = steps.each_ref().map(|actions| actions.chunks_exact(2));
        first.zip(second).flat_map(|(first, second)| [first, second].concat()).collect()
    }

    #[test]
    fn actions_are_drawn_as_the_rule_says_in_the_network_s_units_and_for_each_episode_alone() {
        let affine = json!({"offset": [10.0, -1.0], "scale": [4.0, 0.5]});
        let scaling: Scaling = serde_json::from_value(json!({"actions": affine})).unwrap();
        let seeds = Vec::from_iter(0..2000);
        // Shares of actions within ±0.4 and within ±0.9.
        let noise = |noise| Exploration::Policy { noise };
        for (rule, spread, shares) in [
            (Exploration::Uniform, Spread::None, [0.4, 0.9]),
            (noise(0.4), Spread::None, [0.6827, 0.9756]),
            (noise(0.0), Spread::None, [1.0, 1.0]),
            (noise(0.0), Spread::Shared, [0.3108, 0.6319]),
        ] {
            let [plain, scaled] =
                [None, Some(scaling.clone())].map(|scaling| policy(spread, scaling));
            let drawn = actions(rule, &*plain, &seeds);
            assert!(drawn.iter().all(|action| (-1.0..=1.0).contains(action)));
            for (limit, expected) in [0.4, 0.9].into_iter().zip(shares) {
                let inside = drawn.iter().filter(|x| x.abs() <= limit).count() as f64;
                let above = drawn.iter().filter(|x| **x > limit).count() as f64;
                let [inside, above] = [inside, above].map(|count| count / drawn.len() as f64);
                assert!((inside - expected).abs() < 0.02, "{rule:?}: {inside} within {limit}");
                assert!((above - (1.0 - expected) / 2.0).abs() < 0.02, "{rule:?}: {above}");
            }
            let explores = (rule, spread) != (noise(0.0), Spread::None);
            assert_eq!(drawn[..2] != drawn[2..4], explores, "each step draws anew");

            let alone = actions(rule, &*plain, &[1999, 5]);
            assert_eq!(alone, [&drawn[4 * 1999..], &drawn[20..24]].concat());
            let users = actions(rule, &*scaled, &[5]);
            for (users, drawn) in users.chunks_exact(2).zip(drawn[20..24].chunks_exact(2)) {
                let expected = [10.0 + 4.0 * drawn[0], -1.0 + 0.5 * drawn[1]];
                assert!((users[0] - expected[0]).abs() + (users[1] - expected[1]).abs() < 1e-5);
            }
        }
    }
}
