//! Diffusion over actions: noise schedule, noise predictor with its sampler, guidance by critics,
//! EDM denoiser.

pub(crate) mod denoised;
pub(crate) mod edm;
pub(crate) mod noise_predictor;
mod sampler;
pub(crate) mod schedule;
