//! The QUAD update.
mod config;
pub use config::{AgentConfig, ConfigError, EtaConfig, Guidance, TargetReduce};
