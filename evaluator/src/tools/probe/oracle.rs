//! True values: discounted returns of rollouts that begin with a given action in a given state.

use std::sync::Arc;

use anyhow::Context;
use quad_dataset::{EnvironmentSpec, RewardScaling};
use quad_policy::Policy;
use rayon::prelude::*;
use tracing::info;

use super::states::State;
use crate::sim::{self, Environment, EnvironmentError, Rollout, Simulation, Step};

/// Rollouts per batch. The limit bounds memory; a larger batch is hardly faster.
const BATCH: usize = 256;

/// A rollout to be made.
#[derive(Clone)]
pub struct Query {
    pub state: Arc<State>,
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
    pub fn returns(&self, queries: Vec<Query>) -> anyhow::Result<Vec<f64>> {
        info!("{} rollouts", queries.len());
        let indices = Vec::from_iter(0..queries.len() as u64);
        let queries: Arc<[Query]> = queries.into();
        let batches = indices.par_chunks(BATCH).with_max_len(1);
        let batches = batches.map(|indices| self.roll_out(&queries, indices));
        Ok(batches.collect::<anyhow::Result<Vec<_>>>()?.concat())
    }

    fn roll_out(&self, queries: &Arc<[Query]>, indices: &[u64]) -> anyhow::Result<Vec<f64>> {
        let policy = &*self.policy;
        let sizes = (policy.observation_dim(), policy.action_dim());
        let make = || -> Result<Box<dyn Environment>, EnvironmentError> {
            Ok(Box::new(Continuation {
                simulation: sim::make(self.spec, 0)?,
                queries: queries.clone(),
                first: None,
                rewards: self.rewards,
                gamma: self.gamma,
                discount: 1.0,
                left: self.length,
            }))
        };
        let begin = |index| policy.begin(queries[index as usize].seed);
        let mut rollout = Rollout::new(make, sizes, indices, begin)?;
        while !rollout.is_done() {
            rollout.step(|observations, states, actions| {
                policy.act(observations, states, actions).context("the policy cannot act")
            })?;
        }
        Ok(rollout.into_scores().iter().map(|episode| episode.episode_return).collect())
    }
}

/// An environment whose episodes are the queries, by their indices.
struct Continuation {
    simulation: Simulation,
    queries: Arc<[Query]>,
    /// Taken in place of the policy's action.
    first: Option<Vec<f32>>,
    rewards: RewardScaling,
    gamma: f64,
    discount: f64,
    left: u32,
}

impl Environment for Continuation {
    fn reset(&mut self, index: u64) -> Result<(), EnvironmentError> {
        let Query { state, action, .. } = &self.queries[index as usize];
        self.simulation.set_state(&state.qpos, &state.qvel);
        if let Some(goal) = &state.goal {
            self.simulation.set_goal(goal);
        }
        self.first = Some(action.clone());
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        let first = self.first.take();
        let step = self.simulation.step(first.as_deref().unwrap_or(action));
        let reward = self.discount * f64::from(self.rewards.apply(step.reward as f32));
        self.discount *= self.gamma;
        self.left -= 1;
        Ok(Step { reward, truncated: self.left == 0, ..step })
    }

    fn observation(&self) -> &[f64] {
        self.simulation.observation()
    }

    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
        Ok(episode_return)
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
        let state = Arc::new(State { qpos, qvel, ..State::default() });
        let query = |first, seed| Query { state: state.clone(), action: vec![first; 3], seed };
        let queries = [query(0.5, 1), query(-0.5, 1), query(0.5, 2)];
        let rewards = RewardRule::Subtract1.scaling(&[]).unwrap();
        let mut oracle = Oracle { spec, policy, rewards, gamma: 0.9, length: 0 };
        let mut lengths = Vec::new();
        // The robot falls within the longer one.
        for length in [3, 2000] {
            oracle.length = length;
            let returns = oracle.returns(queries.to_vec()).unwrap();
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
