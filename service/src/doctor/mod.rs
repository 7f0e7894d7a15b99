//! `learner doctor` and `evaluator doctor`: checks of a machine, before a run is started on it.
//!
//! Here is what both programs need; each adds its own checks in its `doctor.rs`.

mod findings;
mod machine;
mod network;

pub use findings::Findings;
pub use machine::{folder, threads};
pub use network::{certificates, connected, port};
