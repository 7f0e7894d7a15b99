//! The learner.
pub mod agent;
pub mod cli;
pub mod config;
pub mod inbox;
pub mod seeds;
