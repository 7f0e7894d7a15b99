//! IDQL (Hansen-Estruch et al. 2023, "IDQL: Implicit Q-Learning as an Actor-Critic Method with
//! Diffusion Policies"): IQL's critics and a diffusion policy that only clones the data, as
//! AlignIQL trains them. When it acts, the policy takes the one of its samples that is worth most.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/idql.rs"]
mod golden;

use super::align_iql::{Config, METRICS};
use super::definition::{Definition, Reporting, read, readable};
use quad_policy::Rule;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "idql",
    settings: include_str!("../../presets/idql.toml"),
    metrics: METRICS,
    report: Reporting { counts: &["candidates"], ..Reporting::PLAIN },
    check: readable::<Config>,
    start: |table, context| Ok(Box::new(read::<Config>(table)?.start(Rule::Best, context)?)),
};
