//! The agent that trains with candle's tensors, and so on any of candle's devices: on a GPU.

use super::noise::NoiseSource;
use super::reference::{Reference, ReferenceState};
use super::{AgentConfig, AgentError, AgentState, StepMetrics, StepNoise, check_batch};
use candle_core::Device;
use quad_dataset::Batch;
use quad_policy::{Architecture, PolicyError};

/// Does what [`super::Agent`] does, with the same initial weights and noise from the same seed.
pub struct TensorAgent {
    config: AgentConfig,
    architecture: Architecture,
    total_steps: u64,
    device: Device,
    state: ReferenceState,
    source: NoiseSource,
    noise: StepNoise,
}

impl TensorAgent {
    /// An agent at step 0 on a device; its learning rates reach 0 at `total_steps`.
    pub fn new(
        architecture: Architecture,
        config: &AgentConfig,
        total_steps: u64,
        seed: u64,
        device: Device,
    ) -> Result<Self, AgentError> {
        config.validate()?;
        Ok(Self {
            state: ReferenceState::new(&AgentState::new(&architecture, config, seed), &device)?,
            source: NoiseSource::new(config, architecture.action_dim, seed),
            noise: StepNoise::default(),
            config: config.clone(),
            architecture,
            total_steps,
            device,
        })
    }

    /// One update with noise from the agent's own stream.
    pub fn update(&mut self, batch: &Batch) -> Result<StepMetrics, AgentError> {
        check_batch(&self.architecture, &self.config, batch)?;
        self.source.fill(&mut self.noise);
        let reference = Reference {
            config: &self.config,
            architecture: self.architecture,
            total_steps: self.total_steps,
            device: self.device.clone(),
        };
        Ok(reference.step(&mut self.state, batch, &self.noise)?)
    }

    /// The target networks as a safetensors file, ready to be acted with.
    pub fn target_safetensors(&self) -> Result<Vec<u8>, AgentError> {
        let targets = self.state.target_actor.iter().chain(&self.state.target_critics);
        let here = targets.map(|(name, tensor)| Ok((name, tensor.to_device(&Device::Cpu)?)));
        let here = here.collect::<candle_core::Result<Vec<_>>>()?;
        Ok(safetensors::serialize(here, None).map_err(PolicyError::from)?)
    }
}
