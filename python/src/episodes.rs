//! `quad_rl.Episodes`: a policy in the middle of episodes, each with its own noise, as an evaluator
//! has it.

use std::mem;
use std::sync::Arc;

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use quad_dataset::Names;
use quad_policy::{EpisodeState, Policy};

use crate::acting::{Array, act, begin};
use crate::arrays::{Like, Rows};

/// Episodes in which a policy acts, as `Policy.begin` gives them. `len` is how many.
#[pyclass(module = "quad_rl")]
pub struct Episodes {
    policy: Arc<dyn Policy>,
    states: Vec<EpisodeState>,
    names: Arc<Names>,
}

impl Episodes {
    /// Begins the episodes of these seeds.
    pub fn new(policy: Arc<dyn Policy>, seeds: &[u64], names: Arc<Names>) -> Self {
        Self { states: begin(&*policy, seeds), policy, names }
    }

    /// These rows, if they are ours and each is named once.
    fn check(&self, rows: Vec<i64>) -> PyResult<Vec<usize>> {
        let mut seen = vec![false; self.states.len()];
        let check = |row| {
            let place =
                usize::try_from(row).ok().filter(|place| *place < seen.len()).ok_or_else(|| {
                    format!(
                        "rows has {row}, but there are {} episodes, counted from 0",
                        self.states.len()
                    )
                })?;
            if mem::replace(&mut seen[place], true) {
                Err(format!("rows has {row} twice"))
            } else {
                Ok(place)
            }
        };
        rows.into_iter().map(check).collect::<Result<_, _>>().map_err(PyValueError::new_err)
    }
}

#[pymethods]
impl Episodes {
    /// The next action of each episode: observations [n, observation_size] -> actions [n,
    /// action_size], float32.
    ///
    /// rows: the episodes, counted from 0, that the observations belong to, for when others have
    /// ended: `episodes.act(observations[alive], rows=alive)`. None: all of them.
    ///
    /// Raises as `Policy.act`; ValueError also if there are more or fewer observations than
    /// episodes.
    #[pyo3(signature = (observations, *, rows = None))]
    fn act<'py>(
        &mut self,
        py: Python<'py>,
        observations: Like<'py>,
        rows: Option<Vec<i64>>,
    ) -> PyResult<Array<'py>> {
        let given = Rows::of(
            "observations",
            &observations,
            self.policy.observation_dim(),
            &self.names.observations,
        )?;
        let rows = match rows {
            Some(rows) => self.check(rows)?,
            None => (0..self.states.len()).collect(),
        };
        if given.count != rows.len() {
            let error = format!("{} rows of observations for {} episodes", given.count, rows.len());
            return Err(PyValueError::new_err(format!(
                "{error}; rows=[…] says to which of them they belong"
            )));
        }
        // Out of the list and back: the policy takes states that lie side by side.
        let mut states: Vec<_> = rows
            .iter()
            .map(|row| mem::replace(&mut self.states[*row], EpisodeState::new(0)))
            .collect();
        let acted = act(py, &*self.policy, &given, &mut states);
        rows.iter().zip(states).for_each(|(row, state)| self.states[*row] = state);
        acted
    }

    fn __len__(&self) -> usize {
        self.states.len()
    }

    fn __repr__(&self) -> String {
        format!("Episodes({})", self.states.len())
    }
}
