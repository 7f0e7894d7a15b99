//! The module `quad_rl._quad_rl`: QUAD for Python.

mod evaluate;

use pyo3::prelude::*;

#[pymodule]
mod _quad_rl {
    #[pymodule_export]
    use crate::evaluate::{serve_environment, simulated};
}
