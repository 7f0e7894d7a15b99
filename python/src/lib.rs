//! The module `quad_rl._quad_rl`: QUAD for Python. `py/quad_rl/_quad_rl.pyi` has its types.

mod acting;
mod arrays;
mod dataset;
mod episodes;
mod error;
mod evaluate;
mod file;
mod policy;
mod simulation;

use pyo3::prelude::*;

#[pymodule]
mod _quad_rl {
    #[pymodule_export]
    use crate::dataset::{benchmark_tasks, inspect_dataset, read_run, write_dataset};
    #[pymodule_export]
    use crate::episodes::Episodes;
    #[pymodule_export]
    use crate::evaluate::{serve_environment, simulated};
    #[pymodule_export]
    use crate::policy::PyPolicy;
    #[pymodule_export]
    use crate::simulation::PySimulation;
}
