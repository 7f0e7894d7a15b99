//! `quad_rl.Episodes`: a policy in several episodes, each with its own noise.

use std::mem;
use std::sync::Arc;

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use quad_dataset::Names;
use quad_policy::{EpisodeState, Policy};

use crate::acting::{Array, act, begin};
use crate::arrays::{ArrayLike, Rows};

/// Episodes in which a policy acts, from `Policy.begin`. `len` is their number.
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

    /// Checks observations of this many episodes.
    fn rows<'a>(&self, observations: &'a ArrayLike<'_>, episodes: usize) -> PyResult<Rows<'a>> {
        let (width, names) = (self.policy.observation_dim(), &self.names.observations);
        let given = Rows::new("observations", observations, width, names)?;
        if given.count != episodes {
            return Err(PyValueError::new_err(format!(
                "{} rows of observations for {episodes} episodes; rows=[…] says to which of them they belong",
                given.count,
            )));
        }
        Ok(given)
    }

    /// Checks that rows are within range and distinct.
    fn check(&self, rows: Vec<i64>) -> PyResult<Vec<usize>> {
        let count = self.states.len();
        let mut seen = vec![false; count];
        let check = |row| match usize::try_from(row).ok().filter(|row| *row < count) {
            None => Err(format!("rows has {row}, but there are {count} episodes, counted from 0")),
            Some(place) if mem::replace(&mut seen[place], true) => {
                Err(format!("rows has {row} twice"))
            }
            Some(place) => Ok(place),
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
        observations: ArrayLike<'py>,
        rows: Option<Vec<i64>>,
    ) -> PyResult<Array<'py>> {
        let rows = match rows {
            Some(rows) => self.check(rows)?,
            None => (0..self.states.len()).collect(),
        };
        let given = self.rows(&observations, rows.len())?;
        // The policy takes a slice of states.
        let take = |row: &usize| mem::replace(&mut self.states[*row], EpisodeState::new(0));
        let mut states: Vec<_> = rows.iter().map(take).collect();
        let acted = act(py, &*self.policy, &given, &mut states);
        rows.iter().zip(states).for_each(|(row, state)| self.states[*row] = state);
        acted
    }

    /// Takes note of the observation of each episode, [n, observation_size], without acting, for a
    /// policy that sees several at a time (`history` of its chunk in `Policy.about`). Raises as `act`.
    fn observe(&mut self, observations: ArrayLike<'_>) -> PyResult<()> {
        let given = self.rows(&observations, self.states.len())?;
        self.policy.observe(&given.values, &mut self.states);
        Ok(())
    }

    fn __len__(&self) -> usize {
        self.states.len()
    }

    fn __repr__(&self) -> String {
        format!("Episodes({})", self.states.len())
    }
}
