//! Kinds of policy, one file each.

pub(crate) mod actor_critic;
pub(crate) mod diffuser;
pub(crate) mod diffusion;
pub(crate) mod flow;
pub(crate) mod gaussian;
pub(crate) mod score;
pub(crate) mod squashed;
