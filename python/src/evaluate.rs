//! Environments in Python, served like `evaluator serve` serves its own.
//!
//! The objects of `quad_rl/_worker.py` and `_environment.py` make, reset and step environments.

use std::path::PathBuf;
use std::sync::Arc;

use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use quad_evaluator::serve::{ServeArgs, serve};
use quad_evaluator::sim::{Environment, EnvironmentError, Environments, Simulations, Step};
use quad_runtime::{hints, init_logging};

/// Environments that Python's factory makes.
struct PythonEnvironments {
    name: String,
    sizes: Option<(usize, usize)>,
    factory: Arc<Py<PyAny>>,
}

/// An environment. When dropped, it goes back to the factory, which may return it again.
struct PythonEnvironment {
    name: String,
    environment: Py<PyAny>,
    factory: Arc<Py<PyAny>>,
    observation: Vec<f64>,
    online: bool,
}

impl Environments for PythonEnvironments {
    fn names(&self) -> Vec<String> {
        vec![self.name.clone()]
    }

    fn sizes(&self, _: &str) -> Option<(usize, usize)> {
        self.sizes
    }

    fn make(
        &self,
        name: &str,
        environment_seed: u64,
    ) -> Result<Box<dyn Environment>, EnvironmentError> {
        let made = Python::attach(|py| self.factory.call_method1(py, "make", (environment_seed,)));
        Ok(Box::new(PythonEnvironment {
            name: name.to_owned(),
            environment: made.map_err(|error| failed(name, &error))?,
            factory: self.factory.clone(),
            observation: Vec::new(),
            online: false,
        }))
    }
}

impl PythonEnvironment {
    /// Calls a method that returns an observation and something else. Keeps the observation.
    fn observe<T>(
        &mut self,
        call: impl FnOnce(&Bound<'_, PyAny>) -> PyResult<(Py<PyAny>, T)>,
    ) -> Result<T, EnvironmentError> {
        let Self { name, environment, observation, .. } = self;
        let called = Python::attach(|py| {
            let (observed, rest) = call(environment.bind(py))?;
            let observed: PyReadonlyArray1<'_, f64> = observed.bind(py).extract()?;
            observation.clear();
            observation.extend(observed.as_array());
            Ok(rest)
        });
        called.map_err(|error| failed(name, &error))
    }
}

impl Environment for PythonEnvironment {
    fn name(&self) -> &str {
        &self.name
    }

    fn allow_interventions(&mut self) {
        self.online = true;
    }

    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError> {
        let arguments = (seed, self.online);
        self.observe(|environment| Ok((environment.call_method1("reset", arguments)?.unbind(), ())))
    }

    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        self.observe(|environment| {
            let action = PyArray1::from_slice(environment.py(), action);
            let stepped = environment.call_method1("step", (action,))?;
            let (observed, reward, terminated, truncated, intervention, clipped) =
                stepped.extract()?;
            Ok((observed, Step { reward, terminated, truncated, intervention, clipped }))
        })
    }

    fn observation(&self) -> &[f64] {
        &self.observation
    }

    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
        let scored = Python::attach(|py| {
            self.environment.bind(py).call_method1("score", (episode_return,))?.extract()
        });
        scored.map_err(|error| failed(&self.name, &error))
    }
}

impl Drop for PythonEnvironment {
    fn drop(&mut self) {
        // The worker logs errors.
        Python::attach(|py| self.factory.call_method1(py, "release", (&self.environment,)).ok());
    }
}

/// The worker's one-line message of an error.
fn failed(name: &str, error: &PyErr) -> EnvironmentError {
    let reason = Python::attach(|py| error.value(py).to_string());
    EnvironmentError::Failed { name: name.to_owned(), reason }
}

/// Serves learners with `factory`'s environments until SIGTERM. `factory` has `make(seed)` and
/// `release(environment)`, an environment `reset(seed, online)`, `step(action)` and `score(return)`.
#[pyfunction]
#[pyo3(signature = (name, factory, *, sizes, connect, certificates, precision))]
pub fn serve_environment(
    py: Python<'_>,
    name: String,
    factory: Py<PyAny>,
    sizes: Option<(usize, usize)>,
    connect: Vec<String>,
    certificates: Option<PathBuf>,
    precision: &str,
) -> PyResult<()> {
    let precision =
        precision.parse().map_err(|error| PyValueError::new_err(format!("precision: {error}")))?;
    let args = ServeArgs {
        connect,
        certificates,
        http: None,
        http_hosts: Vec::new(),
        name: None,
        precision,
    };
    let factory = Arc::new(factory);
    let environments = Arc::new(PythonEnvironments { name, sizes, factory });
    let served = py.detach(|| {
        let _logging = init_logging();
        serve(args, environments)
    });
    served.map_err(|error| {
        let hints = String::from_iter(hints(&error).map(|hint| format!("\nhint: {hint}")));
        PyRuntimeError::new_err(format!("{error:#}{hints}"))
    })
}

/// Names of the environments of `evaluator serve`.
#[pyfunction]
pub fn simulated() -> Vec<String> {
    Simulations.names()
}
