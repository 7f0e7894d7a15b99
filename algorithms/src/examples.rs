//! What an algorithm learns from: which of the data's transitions, and the columns of its batches.

use std::ops::Range;
use std::sync::Arc;

use candle_core::{Device, Result, Tensor};
use quad_dataset::{Transitions, Window};
use quad_nn::Scaling;

use super::batch::Batch;
use super::error::AlgorithmError;
use super::returns::{calibrated, discounted};

/// What an algorithm's table asks for beside (s, a, r, s') of all transitions.
#[derive(Clone, Copy, Debug)]
pub enum Columns {
    /// Nothing.
    Plain,
    /// The data's next actions, on the dataset alone. Leaves out transitions without one, but for the
    /// last of an episode that terminates.
    NextActions,
    /// Cal-QL's returns with this discount γ.
    Returns(f32),
    /// Episodes of at least this many transitions.
    Episodes(usize),
    /// Plans and their returns.
    Plans(Plans),
}

/// Plans of H steps within an episode, or fewer where it terminates.
#[derive(Clone, Copy, Debug)]
pub struct Plans {
    /// H.
    pub horizon: usize,
    /// Discount γ of returns.
    pub gamma: f32,
    /// What is taken off the reward of a step that terminates an episode.
    pub terminal_penalty: f32,
}

/// The examples of a dataset and of experience.
pub struct Examples {
    transitions: Arc<Transitions>,
    columns: Columns,
    window: Window,
    /// The transitions that are examples, or that begin one; `None`: all.
    rows: Option<Vec<u32>>,
    /// By example.
    returns: Vec<f32>,
    /// Steps of each plan.
    lengths: Vec<u32>,
    /// Standard units of plans.
    units: Scaling,
    /// Actions of a policy after all transitions, in place of the data's.
    policy_actions: Option<Vec<f32>>,
}

impl Examples {
    /// Windows of steps with these columns.
    ///
    /// # Errors
    /// The data has none.
    pub fn new(
        transitions: Arc<Transitions>,
        columns: Columns,
        window: Window,
    ) -> std::result::Result<Self, AlgorithmError> {
        let data = transitions.clone();
        let mut examples = Self {
            transitions,
            columns,
            window,
            rows: None,
            returns: Vec::new(),
            lengths: Vec::new(),
            units: Scaling::default(),
            policy_actions: None,
        };
        let none = match columns {
            Columns::Plain => return Ok(examples),
            Columns::Returns(gamma) => {
                examples.add_returns(data.episodes(), gamma);
                return Ok(examples);
            }
            Columns::NextActions => {
                let usable = |row: &u32| data.next_action(*row).is_some() || data.terminates(*row);
                examples.rows = Some((0..data.len() as u32).filter(usable).collect());
                AlgorithmError::NoNextAction
            }
            Columns::Episodes(shortest) => {
                let mut episodes = data.episodes();
                episodes.retain(|episode| episode.len() >= shortest);
                examples.rows = Some(episodes.into_iter().flatten().collect());
                AlgorithmError::ShortEpisodes(shortest)
            }
            Columns::Plans(plans) => {
                examples.units = data.standard_units();
                examples.add_plans(plans);
                AlgorithmError::NoWindow(plans.horizon)
            }
        };
        if examples.len() == 0 { Err(none) } else { Ok(examples) }
    }

    /// The same transitions with the actions that a policy takes after all N of them, `[N, a]`.
    pub fn with_next_actions(self, actions: Vec<f32>) -> Self {
        Self { columns: Columns::NextActions, policy_actions: Some(actions), ..self }
    }

    /// The transitions of the dataset and of experience.
    pub fn transitions(&self) -> &Arc<Transitions> {
        &self.transitions
    }

    /// Number of the dataset's examples; 0 only without a dataset.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.rows.as_ref().map_or(self.transitions.len(), Vec::len)
    }

    /// The dataset's examples with these numbers, on the CPU.
    pub fn batch(&self, indices: &[u32]) -> Result<Batch> {
        let rows = self.rows(indices);
        let mut batch = self.gather(&rows, indices)?;
        match self.columns {
            Columns::NextActions => batch.next_actions = Some(self.next_actions(&rows)?),
            Columns::Plans(plans) => batch.plans = Some(self.plans(indices, plans.horizon)?),
            _ => {}
        }
        Ok(batch)
    }

    /// These transitions of the dataset and, with numbers from [`Transitions::len`] on, of
    /// experience.
    pub fn online_batch(&mut self, rows: &[u32]) -> Result<Batch> {
        let data = self.transitions.clone();
        if let Columns::Returns(gamma) = self.columns
            && self.returns.len() < data.len() + data.experience_len()
        {
            self.add_returns(data.experience_episodes(), gamma);
        }
        self.gather(rows, rows)
    }

    /// The transitions that are these examples, or that begin them.
    pub(super) fn rows(&self, indices: &[u32]) -> Vec<u32> {
        match &self.rows {
            Some(rows) => indices.iter().map(|index| rows[*index as usize]).collect(),
            None => indices.to_vec(),
        }
    }

    /// The windows that begin with these transitions, with the returns of these examples.
    fn gather(&self, rows: &[u32], indices: &[u32]) -> Result<Batch> {
        let (b, device) = (rows.len(), &Device::Cpu);
        let batch = self.transitions.gather_windows(rows, self.window);
        let (a, length) = (self.transitions.action_dim(), self.window.length);
        let row = |n: &usize| [vec![1.0; n * a], vec![0.0; (length - n) * a]].concat();
        let within = (length > 1).then(|| batch.steps.iter().flat_map(row).collect());
        let table = |numbers: Vec<f32>| {
            let width = numbers.len() / b;
            Tensor::from_vec(numbers, (b, width), device)
        };
        let column = |numbers: Vec<f32>| Tensor::from_vec(numbers, b, device);
        let returns = |index: &u32| self.returns[*index as usize];
        let returns = (!self.returns.is_empty()).then(|| indices.iter().map(returns).collect());
        Ok(Batch {
            observations: table(batch.observations)?,
            actions: table(batch.actions)?,
            rewards: column(batch.rewards)?,
            next_observations: table(batch.next_observations)?,
            masks: column(batch.masks)?,
            within: within.map(table).transpose()?,
            next_actions: None,
            returns: returns.map(column).transpose()?,
            plans: None,
            indices: indices.to_vec(),
        })
    }

    /// The actions after these transitions, `[B, a]`; 0 at the end of an episode.
    fn next_actions(&self, rows: &[u32]) -> Result<Tensor> {
        let a = self.transitions.action_dim();
        let mut actions = Vec::with_capacity(rows.len() * a);
        for row in rows {
            let next = match &self.policy_actions {
                Some(actions) => Some(&actions[*row as usize * a..][..a]),
                None => self.transitions.next_action(*row),
            };
            match next {
                Some(next) => actions.extend_from_slice(next),
                None => actions.resize(actions.len() + a, 0.0),
            }
        }
        Tensor::from_vec(actions, (rows.len(), a), &Device::Cpu)
    }

    /// Adds the returns of the episodes that begin after those before.
    fn add_returns(&mut self, episodes: Vec<Range<u32>>, gamma: f32) {
        let done = self.returns.len() as u32;
        for episode in episodes.into_iter().filter(|episode| episode.start >= done) {
            let (rewards, terminates) = episode_rewards(&self.transitions, episode);
            self.returns.extend(calibrated(&rewards, terminates, gamma.into()));
        }
    }

    fn add_plans(&mut self, plans: Plans) {
        let horizon = plans.horizon as u32;
        let mut rows = Vec::new();
        for episode in self.transitions.episodes() {
            let (rewards, terminates) = episode_rewards(&self.transitions, episode.clone());
            let last = if terminates { -f64::from(plans.terminal_penalty) } else { 0.0 };
            let returns = discounted(&rewards, plans.gamma.into(), last);
            for (row, value) in episode.clone().zip(returns) {
                let length = (episode.end - row).min(horizon);
                if terminates || length == horizon {
                    rows.push(row);
                    self.lengths.push(length);
                    self.returns.push(value as f32);
                }
            }
        }
        self.rows = Some(rows);
    }

    /// [action, state] of the steps of these plans in standard units, `[B, H, a + o]`. After the end
    /// of an episode there are zeros, in the data's units.
    fn plans(&self, indices: &[u32], horizon: usize) -> Result<Tensor> {
        let (o, a) = (self.transitions.observation_dim(), self.transitions.action_dim());
        let mut numbers = Vec::new();
        for (index, row) in indices.iter().zip(self.rows(indices)) {
            let last = row + self.lengths[*index as usize];
            let mut steps = self.transitions.gather(&Vec::from_iter(row..last));
            steps.actions.resize(horizon * a, 0.0);
            steps.observations.resize(horizon * o, 0.0);
            for (units, numbers) in [
                (&self.units.actions, &mut steps.actions),
                (&self.units.observations, &mut steps.observations),
            ] {
                units.iter().for_each(|affine| affine.to_network(numbers));
            }
            for (action, state) in steps.actions.chunks(a).zip(steps.observations.chunks(o)) {
                numbers.extend_from_slice(action);
                numbers.extend_from_slice(state);
            }
        }
        Tensor::from_vec(numbers, (indices.len(), horizon, a + o), &Device::Cpu)
    }
}

/// The rewards of an episode, and if it terminates.
pub(super) fn episode_rewards(transitions: &Transitions, episode: Range<u32>) -> (Vec<f32>, bool) {
    let batch = transitions.gather(&Vec::from_iter(episode));
    let terminates = batch.masks.last() == Some(&0.0);
    (batch.rewards, terminates)
}

#[cfg(test)]
mod tests {
    use super::*;
    use quad_dataset::{Arrays, OnlineEpisode};

    /// Two steps that terminate, two that are cut off with one reward, and one that is cut off.
    fn transitions() -> Arc<Transitions> {
        let arrays = Arrays {
            observation_dim: 1,
            action_dim: 1,
            observations: vec![0.0, 1.0, 0.0, 1.0, 0.0],
            next_observations: vec![1.0, 2.0, 1.0, 2.0, 1.0],
            actions: vec![0.0, 0.1, 0.2, 0.3, 0.4],
            rewards: vec![1.0, 4.0, -1.0, -1.0, -3.0],
            terminals: vec![false, true, false, false, false],
            timeouts: vec![false, false, false, true, true],
        };
        Arc::new(Transitions::of(arrays).unwrap())
    }

    fn examples(columns: Columns) -> Examples {
        Examples::new(transitions(), columns, Window::ONE).unwrap()
    }

    fn numbers(tensor: &Option<Tensor>) -> Vec<f32> {
        tensor.as_ref().unwrap().flatten_all().unwrap().to_vec1().unwrap()
    }

    #[test]
    fn transitions_without_a_next_action_are_left_out() {
        let examples = examples(Columns::NextActions);
        assert_eq!(examples.rows(&[0, 1, 2]), [0, 1, 2]);
        assert_eq!(examples.len(), 3);
        assert_eq!(numbers(&examples.batch(&[2, 0, 1]).unwrap().next_actions), [0.3, 0.1, 0.0]);
        let policy = examples.with_next_actions(vec![0.5, 0.6, 0.7, 0.8, 0.9]);
        assert_eq!(numbers(&policy.batch(&[0, 2]).unwrap().next_actions), [0.5, 0.7]);
    }

    #[test]
    fn returns_reach_to_the_end_of_episodes_and_follow_experience() {
        let mut examples = examples(Columns::Returns(0.5));
        let mut expected = vec![3.0, 4.0, -2.0, -2.0, -3.0];
        assert_eq!(examples.returns, expected);
        for (rewards, terminated, more) in
            [([0.0, 2.0], true, [1.0, 2.0]), ([-1.0, -1.0], false, [-2.0, -2.0])]
        {
            let (observations, actions) = (&[0.0, 1.0, 2.0], &[0.0; 2]);
            let rewards = &rewards;
            let episode = OnlineEpisode { observations, actions, rewards, terminated };
            examples.transitions.add_episode(episode).unwrap();
            expected.extend(more);
            let batch = examples.online_batch(&Vec::from_iter(0..expected.len() as u32)).unwrap();
            assert_eq!(numbers(&batch.returns), expected);
        }
    }

    /// The episode that terminates also has plans of one step; those that are cut off have none that
    /// run past their end.
    #[test]
    fn plans_have_the_discounted_rewards_to_the_end_of_their_episode() {
        let plans = Plans { horizon: 2, gamma: 0.5, terminal_penalty: 8.0 };
        let examples = examples(Columns::Plans(plans));
        assert_eq!(examples.rows(&[0, 1, 2]), [0, 1, 2]);
        assert_eq!((examples.len(), &examples.lengths[..]), (3, &[2, 1, 2][..]));
        assert_eq!(examples.returns, [-1.0, -4.0, -1.5]);
        let batch = examples.batch(&[1]).unwrap();
        let [action, state] = [&examples.units.actions, &examples.units.observations]
            .map(|affine| affine.clone().unwrap());
        let unit = |affine: &quad_nn::Affine, x: f32| (x - affine.offset[0]) / affine.scale[0];
        let expected =
            [unit(&action, 0.1), unit(&state, 1.0), unit(&action, 0.0), unit(&state, 0.0)];
        let apart = numbers(&batch.plans).into_iter().zip(expected).map(|(x, y)| (x - y).abs());
        assert!(apart.fold(0.0, f32::max) < 1e-6);
    }
}
