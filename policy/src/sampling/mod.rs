//! Sampling candidate actions, and the choice among them.

pub(crate) mod candidates;
pub(crate) mod choice;
pub(crate) mod episode;
