//! The learner.
pub mod agent;
