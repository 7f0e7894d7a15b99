//! True values: discounted returns of rollouts that begin with a given action in a given state.

use anyhow::Context;
use quad_dataset::{EnvironmentSpec, RewardScaling};
use quad_policy::Policy;
use rayon::prelude::*;
use tracing::info;

use super::states::State;
use crate::sim::{self, EnvironmentError};

/// Rollouts per batch. The limit bounds memory; a larger batch is hardly faster.
const BATCH: usize = 256;

/// A rollout to be made.
pub struct Query<'a> {
    pub state: &'a State,
    /// The first action.
    pub action: Vec<f32>,
    /// Seed of the policy's noise.
    pub seed: u64,
}

pub struct Oracle {
    pub spec: &'static EnvironmentSpec,
    /// Acts after the first action.
    pub policy: Box<dyn Policy>,
    pub rewards: RewardScaling,
    pub gamma: f64,
    /// Most steps of a rollout.
    pub length: u32,
}

impl Oracle {
    /// The discounted return of each rollout, in the critics' units.
    pub fn returns(&self, queries: &[Query<'_>]) -> anyhow::Result<Vec<f64>> {
        info!("{} rollouts", queries.len());
        let batches = queries.par_chunks(BATCH).with_max_len(1);
        let returns = batches.map(|batch| self.roll_out(batch));
        Ok(returns.collect::<anyhow::Result<Vec<_>>>()?.concat())
    }

    fn roll_out(&self, queries: &[Query<'_>]) -> anyhow::Result<Vec<f64>> {
        let (policy, width) = (&*self.policy, self.policy.action_dim());
        let begin = |query: &Query<'_>| {
            let mut simulation = sim::make(self.spec, 0)?;
            simulation.set_state(&query.state.qpos, &query.state.qvel);
            if let Some(goal) = &query.state.goal {
                simulation.set_goal(goal);
            }
            Ok(simulation)
        };
        let live = queries.iter().map(begin).collect::<Result<Vec<_>, EnvironmentError>>()?;
        let mut live = Vec::from_iter(live.into_iter().enumerate());
        let mut memories = Vec::from_iter(queries.iter().map(|query| policy.begin(query.seed)));
        let (mut returns, mut discount) = (vec![0.0; queries.len()], 1.0);
        for step in 0..self.length {
            if live.is_empty() {
                break;
            }
            let observed = live.iter().flat_map(|(_, simulation)| simulation.observation());
            let observations = Vec::from_iter(observed.map(|x| *x as f32));
            let mut actions = vec![0.0; live.len() * width];
            let acted = policy.act(&observations, &mut memories, &mut actions);
            acted.context("the policy cannot act")?;
            for row in (0..live.len()).rev() {
                let (index, simulation) = &mut live[row];
                let action = match step {
                    0 => &*queries[*index].action,
                    _ => &actions[row * width..][..width],
                };
                let step = simulation.step(action);
                returns[*index] += discount * f64::from(self.rewards.apply(step.reward as f32));
                if step.terminated {
                    live.swap_remove(row);
                    memories.swap_remove(row);
                }
            }
            discount *= self.gamma;
        }
        Ok(returns)
    }
}

#[cfg(test)]
mod tests {
    use quad_dataset::{RewardRule, environment};
    use quad_policy::{Precision, load_policy};

    use super::*;
    use crate::serve::fixtures::{file, smallest};

    #[test]
    fn a_return_is_that_of_stepping_from_the_state() {
        let spec = environment::find("hopper").unwrap();
        // Its actions are random, as all weights are 0.
        let policy = load_policy(&file("hopper", smallest(), 1), Precision::F32).unwrap();
        let mut hopper = sim::make(spec, 0).unwrap();
        hopper.reset(3);
        hopper.step(&[0.3, -0.2, 0.1]);
        let (qpos, qvel) = (hopper.qpos().to_vec(), hopper.qvel().to_vec());
        let state = State { qpos, qvel, ..State::default() };
        let query = |first, seed| Query { state: &state, action: vec![first; 3], seed };
        let queries = [query(0.5, 1), query(-0.5, 1), query(0.5, 2)];
        let rewards = RewardRule::Subtract1.scaling(&[]).unwrap();
        let mut oracle = Oracle { spec, policy, rewards, gamma: 0.9, length: 0 };
        let mut lengths = Vec::new();
        // The robot falls within the longer one.
        for length in [3, 2000] {
            oracle.length = length;
            let returns = oracle.returns(&queries).unwrap();
            for (Query { action, seed, .. }, found) in queries.iter().zip(&returns) {
                hopper.set_state(&state.qpos, &state.qvel);
                let (mut memory, mut expected, mut n) = ([oracle.policy.begin(*seed)], 0.0, 0);
                loop {
                    let observation = hopper.observation().iter().map(|x| *x as f32);
                    let (observation, mut own) = (Vec::from_iter(observation), vec![0.0; 3]);
                    oracle.policy.act(&observation, &mut memory, &mut own).unwrap();
                    let step = hopper.step(if n == 0 { action } else { &own });
                    expected += 0.9f64.powi(n) * (step.reward - 1.0);
                    n += 1;
                    if step.terminated || n == length as i32 {
                        break;
                    }
                }
                assert!((found - expected).abs() < 1e-5, "{found}, not {expected}");
                lengths.push(n);
            }
            assert!(returns[0] != returns[1] && returns[0] != returns[2]);
        }
        assert!(lengths[..3] == [3; 3] && lengths[3..].iter().all(|n| *n < 2000), "{lengths:?}");
    }
}
