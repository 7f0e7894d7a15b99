//! `learner doctor` and `evaluator doctor`: checks of a machine, before a run is started on it.
//!
//! These checks are for both programs; each program adds its own in its `doctor.rs`.

mod findings;
mod machine;
mod network;

pub use findings::Findings;
pub use machine::{folder, threads};
pub use network::{certificates, connected, port};
