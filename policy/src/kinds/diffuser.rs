//! Diffuser's policy: it plans from the current state and executes the first actions of the plan
//! with the largest value (Janner et al. 2022, Algorithm 1).

use crate::error::{PolicyError, Result, check_numbers};
use crate::kinds::planner::{CHUNK, DiffuserShape, Planner};
use crate::policy::{Policy, Samples};
use crate::sampling::choice::{Choice, Rule};
use crate::sampling::episode::EpisodeState;
use quad_nn::{Precision, Tensors, TrajectoryModel, TrajectoryValue, Weighted, Weights, f32_bytes};
use std::sync::Arc;

/// Prefixes of the tensors' names.
pub(crate) const MODEL: &str = "model.";
pub(crate) const VALUE: &str = "value.";

/// Diffuser's policy.
pub struct DiffuserPolicy {
    choice: Choice,
    /// Shared with copies that have another choice.
    planner: Arc<Planner>,
}

impl DiffuserPolicy {
    /// The tensors of a policy's file.
    pub fn tensors(
        model: &TrajectoryModel,
        value: &TrajectoryValue,
    ) -> candle_core::Result<Tensors> {
        let mut tensors = model.weights().tensors(MODEL)?;
        tensors.extend(value.weights().tensors(VALUE)?);
        Ok(tensors)
    }

    pub(crate) fn load(
        shape: DiffuserShape,
        choice: Choice,
        tensors: &mut Tensors,
    ) -> Result<Self> {
        shape.check()?;
        let (config, width) = (&shape.network, shape.width());
        let model = Weights::take(TrajectoryModel::layout(config, width), tensors, MODEL)?;
        let value = Weights::take(TrajectoryValue::layout(config, width), tensors, VALUE)?;
        let model = TrajectoryModel::new(config.clone(), model);
        let value = TrajectoryValue::new(config.clone(), value);
        Self::new(Arc::new(Planner::new(shape, model, value)), choice)
    }

    fn new(planner: Arc<Planner>, choice: Choice) -> Result<Self> {
        choice.check()?;
        match choice.rule {
            Rule::Nearest => Err(PolicyError::NoValue),
            _ if choice.guidance != 0.0 => Err(PolicyError::NoGuidance),
            _ => Ok(Self { choice, planner }),
        }
    }

    fn shape(&self) -> &DiffuserShape {
        &self.planner.shape
    }

    /// Plans in some states. Returns the first actions of all plans, `states × plans × replan_every ×
    /// action_dim`, and their values, `states × plans`.
    fn plan(
        &self,
        observations: &[f32],
        states: &mut [&mut EpisodeState],
    ) -> Result<(Vec<f32>, Vec<f32>)> {
        let (n, steps) = (states.len(), self.shape().diffusion_steps);
        let trajectory = self.shape().network.horizon * self.shape().width();
        let row = self.choice.candidates as usize * trajectory;
        let mut noise = vec![0.0; steps * n * row];
        for (i, state) in states.iter_mut().enumerate() {
            for step in 0..steps {
                state.fill_normal(&mut noise[(step * n + i) * row..][..row]);
            }
        }
        let planned = self.planner.plan(observations, &noise)?;
        check_numbers("an action of a plan", &planned.0)?;
        check_numbers("the value of a plan", &planned.1)?;
        Ok(planned)
    }

    /// Numbers in the executed actions of a plan.
    fn taken(&self) -> usize {
        self.shape().replan_every * self.shape().action_dim
    }
}

/// The states without a plan, and their observations.
fn without_plan<'a>(
    observations: &[f32],
    states: &'a mut [EpisodeState],
) -> (Vec<f32>, Vec<&'a mut EpisodeState>) {
    let each = observations.chunks_exact(observations.len() / states.len());
    let lacking = each.zip(states).filter(|(_, state)| state.memory.is_empty());
    let (observations, states): (Vec<&[f32]>, _) = lacking.unzip();
    (observations.concat(), states)
}

/// Removes the next action of a state's plan. Returns the plan's value and the action.
fn next_of_plan(state: &mut EpisodeState, action_dim: usize) -> (f32, Vec<f32>) {
    let value = state.memory[0];
    let action = state.memory.drain(1..=action_dim).collect();
    if state.memory.len() == 1 {
        state.memory.clear();
    }
    (value, action)
}

impl Policy for DiffuserPolicy {
    fn observation_dim(&self) -> usize {
        self.shape().observation_dim
    }

    fn action_dim(&self) -> usize {
        self.shape().action_dim
    }

    fn precision(&self) -> Precision {
        Precision::F32
    }

    fn choice(&self) -> Option<Choice> {
        Some(self.choice)
    }

    fn with_choice(&self, choice: Choice) -> Result<Box<dyn Policy>> {
        Ok(Box::new(Self::new(self.planner.clone(), choice)?))
    }

    fn memory(&self, states: usize) -> u64 {
        let rows = states as u128 * u128::from(self.choice.candidates);
        let trajectory = (self.shape().network.horizon * self.shape().width()) as u128;
        let noise = trajectory * self.shape().diffusion_steps as u128;
        let drawn = rows * (noise + 2 * self.taken() as u128 + 2);
        let observations = 2 * (states * self.shape().observation_dim) as u128;
        f32_bytes(drawn + observations + rows.min(CHUNK as u128) * self.shape().floats())
    }

    fn noise(&self) -> Vec<usize> {
        let plans = self.choice.candidates as usize;
        let shape = self.shape();
        vec![shape.diffusion_steps, plans, shape.network.horizon, shape.width()]
    }

    /// Takes the next action of each state's plan, planning where it has none.
    fn act(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<()> {
        let (plans, taken) = (self.choice.candidates as usize, self.taken());
        let (lacking, mut planning) = without_plan(observations, states);
        if !planning.is_empty() {
            let (planned, values) = self.plan(&lacking, &mut planning)?;
            let of_each = planned.chunks_exact(plans * taken).zip(values.chunks_exact(plans));
            for (state, (planned, values)) in planning.into_iter().zip(of_each) {
                let chosen = self.choice.pick(values, state)?;
                // The value, then the actions; the mean, where several plans are chosen.
                let mean = |of: &dyn Fn(usize) -> f32| {
                    chosen.iter().map(|plan| of(*plan)).sum::<f32>() / chosen.len() as f32
                };
                state.memory.push(mean(&|plan| values[plan]));
                state.memory.extend((0..taken).map(|i| mean(&|plan| planned[plan * taken + i])));
            }
        }
        for (action, state) in actions.chunks_exact_mut(self.shape().action_dim).zip(states) {
            action.copy_from_slice(&next_of_plan(state, action.len()).1);
        }
        Ok(())
    }

    /// The first action and the value of each new plan. A state with a plan repeats its next action
    /// and its value instead.
    fn sample(&self, observations: &[f32], states: &mut [EpisodeState]) -> Result<Samples> {
        let (plans, action_dim) = (self.choice.candidates as usize, self.shape().action_dim);
        let (lacking, mut planning) = without_plan(observations, states);
        let (planned, drawn) = match planning.is_empty() {
            true => (Vec::new(), Vec::new()),
            false => self.plan(&lacking, &mut planning)?,
        };
        let mut planned = planned.chunks_exact(self.taken());
        let mut drawn = drawn.chunks_exact(plans);
        let (mut actions, mut values) = (Vec::new(), Vec::new());
        for state in states {
            if state.memory.is_empty() {
                let firsts = planned.by_ref().take(plans);
                actions.extend(firsts.flat_map(|plan| &plan[..action_dim]));
                values.extend(drawn.next().into_iter().flatten());
            } else {
                let (value, action) = next_of_plan(state, action_dim);
                actions.extend(action.repeat(plans));
                values.extend(vec![value; plans]);
            }
        }
        Ok(Samples { actions, values })
    }
}

#[cfg(test)]
mod tests;
