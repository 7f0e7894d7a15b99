//! What training asks of an agent, wherever its numbers lie.

use super::{Agent, AgentError, StepMetrics, TensorAgent};
use quad_dataset::Batch;

/// An agent that can be trained.
pub trait Trainee {
    /// One update with noise from the agent's own stream.
    fn update(&mut self, batch: &Batch) -> Result<StepMetrics, AgentError>;

    /// The target networks as a safetensors file, ready to be acted with.
    fn target_safetensors(&self) -> Result<Vec<u8>, AgentError>;
}

impl Trainee for Agent {
    fn update(&mut self, batch: &Batch) -> Result<StepMetrics, AgentError> {
        self.update(batch)
    }

    fn target_safetensors(&self) -> Result<Vec<u8>, AgentError> {
        self.target_safetensors()
    }
}

impl Trainee for TensorAgent {
    fn update(&mut self, batch: &Batch) -> Result<StepMetrics, AgentError> {
        self.update(batch)
    }

    fn target_safetensors(&self) -> Result<Vec<u8>, AgentError> {
        self.target_safetensors()
    }
}
