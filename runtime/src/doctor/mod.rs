//! Checks of a machine for `learner doctor` and `evaluator doctor`. Each program adds its own in its
//! `doctor.rs`.

mod findings;
mod machine;
mod network;

pub use findings::Findings;
pub use machine::{folder, threads};
pub use network::{certificates, connected, port};
