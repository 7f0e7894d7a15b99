//! `quad_rl.Policy`: a trained policy, read from the file of a snapshot.

use std::path::PathBuf;
use std::sync::Arc;

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyTuple};
use quad_dataset::Names;
use quad_policy::{Header, Policy, PolicyConfig, Precision};
use quad_protocol::Origin;
use quad_run::files;

use crate::acting::{
    Array, act, as_dictionary, begin, choosing, compute, noise, not_seeds, parts, seeds,
};
use crate::arrays::{ArrayLike, Rows};
use crate::episodes::Episodes;
use crate::file::{HINT, all_about, read};

/// A policy that `learner train` has saved: `Policy.load(path)`.
///
/// Observations and actions have the units of the data. All calls release Python's lock and use
/// rayon's threads; the environment variable RAYON_NUM_THREADS sets their number before the first
/// call. In a process that was forked after a call, calls raise RuntimeError; with multiprocessing
/// use "spawn".
#[pyclass(name = "Policy", module = "quad_rl", frozen)]
pub struct PyPolicy {
    policy: Arc<dyn Policy>,
    /// Numbers in an observation.
    #[pyo3(get)]
    observation_size: usize,
    /// Numbers in an action.
    #[pyo3(get)]
    action_size: usize,
    /// "diffusion", "squashed" (a Gaussian through a tanh), "one-step" (FQL's), "flow" (QC's) or "score"
    /// (SfBC's), which draw actions and choose; "planner", which draws plans and chooses one; or "gaussian",
    /// which acts by its mean.
    #[pyo3(get)]
    kind: &'static str,
    /// The environment that it was trained for.
    #[pyo3(get)]
    environment: String,
    /// The gradient step of the snapshot.
    #[pyo3(get)]
    step: u64,
    /// Precision in effect, "f32" or "bf16".
    #[pyo3(get)]
    precision: &'static str,
    names: Arc<Names>,
    /// The file's header as JSON.
    about: String,
    /// The file and the requested precision, for copies.
    file: Vec<u8>,
    asked: Precision,
}

#[pymethods]
impl PyPolicy {
    /// Reads the file of a snapshot, like "runs/mine/snapshots/step_000020000.safetensors".
    ///
    /// precision: "f32", or "bf16", which is less exact and faster on CPUs with AMX or AMD's
    /// AVX512-BF16; on others it warns and uses f32.
    ///
    /// Raises OSError if the file cannot be read, ValueError if it is no policy.
    #[staticmethod]
    #[pyo3(signature = (path, precision = "f32"))]
    fn load(py: Python<'_>, path: PathBuf, precision: &str) -> PyResult<Self> {
        let name = path.display().to_string();
        let file = py.detach(|| files::read_named(&path)).map_err(|error| {
            let message = format!("cannot read {name}: {error}\nhint: {HINT}");
            std::io::Error::new(error.kind(), message)
        })?;
        Self::from_bytes(py, file, precision, &name)
    }

    /// As `load`, from the file's bytes; errors call the file `name`.
    #[staticmethod]
    #[pyo3(signature = (file, precision = "f32", name = "the file"))]
    fn from_bytes(py: Python<'_>, file: Vec<u8>, precision: &str, name: &str) -> PyResult<Self> {
        let (asked, policy, header) = read(py, &file, precision, name)?;
        let about = all_about(&header);
        let Header { policy: config, observation_names, action_names, origin, .. } = header;
        let Origin { environment, step, .. } = origin;
        Ok(Self {
            observation_size: policy.observation_dim(),
            action_size: policy.action_dim(),
            kind: kind(&config),
            precision: policy.precision().name(),
            environment,
            step,
            names: Arc::new(Names { observations: observation_names, actions: action_names }),
            policy: policy.into(),
            about,
            file,
            asked,
        })
    }

    /// Acts in n states: observations [n, observation_size] -> actions [n, action_size], float32.
    ///
    /// observations: an array of one axis is one state, and gives one action. Contiguous float32
    ///     arrays are not copied; anything else that NumPy takes is converted. A dictionary is read by
    ///     `observation_names`, in any order: single numbers are one state, arrays [n] are n; other
    ///     keys are ignored.
    /// candidates: the number of actions drawn in each state. rule: the choice among them, "best",
    ///     "softmax:TEMPERATURE", "average:TEMPERATURE:ACTIONS" (the mean of so many) or "nearest".
    ///     aggregate: the "mean" or "min" of the critics, or "mean-minus-std:KAPPA". guidance: the
    ///     strength at which their gradients guide a diffusion policy, per unit of their values; 0 for
    ///     none. None: the file's `choice`.
    /// seed: an int: row i draws from seed + i, as an evaluator does in the first step of the episode
    ///     of that seed. A sequence of n ints: a seed for each row. None: fresh random numbers.
    ///
    /// For whole episodes see `begin`.
    ///
    /// Raises ValueError for another shape, NaN or infinite numbers, or a choice that this policy
    /// cannot make; RuntimeError if its networks give no number.
    #[pyo3(signature = (observations, *, candidates = None, rule = None, aggregate = None, guidance = None, seed = None))]
    #[expect(clippy::too_many_arguments, reason = "they are Python's")]
    fn act<'py>(
        &self,
        py: Python<'py>,
        observations: ArrayLike<'py>,
        candidates: Option<i64>,
        rule: Option<String>,
        aggregate: Option<String>,
        guidance: Option<f32>,
        seed: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Array<'py>> {
        let rows = self.rows(&observations)?;
        let policy = choosing(&self.policy, candidates, rule, aggregate, guidance)?;
        let mut states = begin(&*policy, &seeds(seed, rows.count)?);
        act(py, &*policy, &rows, &mut states)
    }

    /// Draws candidates of `act`: (actions [n, candidates, action_size], values [n, candidates]),
    /// float32; for one state, without the first axis. With the same seed, `act` chooses among these.
    /// Raises as `act`, and ValueError if the policy has no critics.
    #[pyo3(signature = (observations, *, candidates = None, aggregate = None, guidance = None, seed = None))]
    fn sample<'py>(
        &self,
        py: Python<'py>,
        observations: ArrayLike<'py>,
        candidates: Option<i64>,
        aggregate: Option<String>,
        guidance: Option<f32>,
        seed: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<(Array<'py>, Array<'py>)> {
        let rows = self.rows(&observations)?;
        let policy = choosing(&self.policy, candidates, None, aggregate, guidance)?;
        let mut states = begin(&*policy, &seeds(seed, rows.count)?);
        let (actions, values) = compute(py, || {
            let (mut actions, mut values) = (Vec::new(), Vec::new());
            for (observations, states) in parts(&*policy, &rows.values, &mut states) {
                let sampled = policy.sample(observations, states)?;
                actions.extend(sampled.actions);
                values.extend(sampled.values);
            }
            Ok((actions, values))
        })?;
        let candidates = policy.choice().map_or(1, |choice| choice.candidates as usize);
        let actions = rows.array(py, actions, &[candidates, policy.action_dim()])?;
        Ok((actions, rows.array(py, values, &[candidates])?))
    }

    /// The critics' values of actions, discounted returns of the scaled rewards: observations [n,
    /// observation_size], actions [n, action_size] -> [n], float32. For one state and action, an array
    /// without axes.
    ///
    /// aggregate: as in `act`. Raises as `act`, and ValueError if the policy has no critics.
    #[pyo3(signature = (observations, actions, *, aggregate = None))]
    fn value<'py>(
        &self,
        py: Python<'py>,
        observations: ArrayLike<'py>,
        actions: ArrayLike<'py>,
        aggregate: Option<String>,
    ) -> PyResult<Array<'py>> {
        let rows = self.rows(&observations)?;
        let taken = Rows::new("actions", &actions, self.action_size, &self.names.actions)?;
        let (n, m) = (rows.count, taken.count);
        if (m, taken.single) != (n, rows.single) {
            let error = format!("{n} observations, but {m} actions: one action for each");
            return Err(PyValueError::new_err(error));
        }
        let policy = choosing(&self.policy, None, None, aggregate, None)?;
        let values = match rows.count {
            0 => Vec::new(),
            _ => compute(py, || policy.value(&rows.values, &taken.values))?,
        };
        rows.array(py, values, &[])
    }

    /// The noise that `act` draws with these arguments in n states, as inputs of the models of
    /// `export_onnx`: a dictionary of "noise", standard normal numbers [n, ...], and "uniform", numbers
    /// within [0, 1), [n, draws], float32, without those that the policy does not draw. Raises as
    /// `act`.
    #[pyo3(signature = (n, *, candidates = None, rule = None, aggregate = None, guidance = None, seed = None))]
    #[expect(clippy::too_many_arguments, reason = "they are Python's")]
    fn noise<'py>(
        &self,
        py: Python<'py>,
        n: usize,
        candidates: Option<i64>,
        rule: Option<String>,
        aggregate: Option<String>,
        guidance: Option<f32>,
        seed: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let policy = choosing(&self.policy, candidates, rule, aggregate, guidance)?;
        noise(py, &*policy, &mut begin(&*policy, &seeds(seed, n)?))
    }

    /// Begins an episode for each seed (an int or a sequence). The policy draws as in an evaluator:
    /// equal seeds and observations give equal actions, bit for bit.
    ///
    ///     episodes = policy.begin([0, 1, 2])
    ///     actions = episodes.act(observations)  # [3, observation_size] -> [3, action_size]
    #[pyo3(signature = (seeds, *, candidates = None, rule = None, aggregate = None, guidance = None))]
    fn begin(
        &self,
        seeds: &Bound<'_, PyAny>,
        candidates: Option<i64>,
        rule: Option<String>,
        aggregate: Option<String>,
        guidance: Option<f32>,
    ) -> PyResult<Episodes> {
        let policy = choosing(&self.policy, candidates, rule, aggregate, guidance)?;
        let seeds = match seeds.extract::<u64>() {
            Ok(seed) => vec![seed],
            Err(_) => seeds.extract().map_err(|_| not_seeds("a sequence of them"))?,
        };
        Ok(Episodes::new(policy, &seeds, self.names.clone()))
    }

    /// Names of the numbers in an observation, from the data; empty if it has none.
    #[getter]
    fn observation_names(&self) -> Vec<String> {
        self.names.observations.clone()
    }

    /// Names of the numbers in an action.
    #[getter]
    fn action_names(&self) -> Vec<String> {
        self.names.actions.clone()
    }

    /// The file's header, a dictionary: version of the learner, environment, step, names of the
    /// numbers in observations and actions, chunk (its length, the steps of it that are executed, and
    /// the observations that it is drawn from), scaling (data's = offset + scale · network's, or
    /// None); and from `learner export` run, task, algorithm, data with its license, score, and
    /// judgment.
    #[getter]
    fn about<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        py.import("json")?.call_method1("loads", (&self.about,))
    }

    /// The choice among candidates: a dictionary of `act`'s arguments candidates, rule, aggregate and
    /// guidance; None if the policy has no critics.
    #[getter]
    fn choice<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        self.policy.choice().map(|choice| as_dictionary(py, choice)).transpose()
    }

    /// The file that it was loaded from, as `from_bytes` takes it.
    fn to_bytes<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, &self.file)
    }

    fn __repr__(&self) -> String {
        let choice = self.policy.choice().map_or(String::new(), |choice| format!(", {choice}"));
        format!(
            "Policy({}, {} after step {}, {} -> {} numbers{choice}, {})",
            self.environment,
            self.kind,
            self.step,
            self.observation_size,
            self.action_size,
            self.precision
        )
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyTuple>> {
        let (py, this) = (slf.py(), slf.get());
        let arguments = (PyBytes::new(py, &this.file), this.asked.name());
        (slf.get_type().getattr("from_bytes")?, arguments).into_pyobject(py)
    }
}

impl PyPolicy {
    fn rows<'a>(&self, observations: &'a ArrayLike<'_>) -> PyResult<Rows<'a>> {
        let (width, names) = (self.observation_size, &self.names.observations);
        Rows::new("observations", observations, width, names)
    }
}

fn kind(config: &PolicyConfig) -> &'static str {
    match config {
        PolicyConfig::Diffusion { .. } => "diffusion",
        PolicyConfig::Squashed { .. } => "squashed",
        PolicyConfig::OneStep { .. } => "one-step",
        PolicyConfig::Flow { .. } => "flow",
        PolicyConfig::Gaussian { .. } => "gaussian",
        PolicyConfig::Score { .. } => "score",
        PolicyConfig::Diffuser { .. } => "planner",
    }
}
