//! Diffusion over actions: noise schedule, noise predictor, EDM denoiser, reverse chain.

pub(crate) mod edm;
pub(crate) mod noise_predictor;
pub(crate) mod sampler;
pub(crate) mod schedule;
