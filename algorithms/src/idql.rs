//! IDQL (Hansen-Estruch et al. 2023, "IDQL: Implicit Q-Learning as an Actor-Critic Method with
//! Diffusion Policies"): IQL's critics and a diffusion policy that only clones the data, as
//! AlignIQL trains them. When it acts, the policy takes its sample of the largest value.

use super::align_iql::{Config, METRICS};
use super::prelude::*;

pub(super) const DEFINITION: Definition = Definition {
    name: "idql",
    presets: include_str!("../../presets/idql.toml"),
    metrics: METRICS,
    chunks: true,
    read: |table| {
        Ok(start(read::<Config>(table)?, |config, context| config.start(Rule::Best, context)))
    },
    ..Definition::PLAIN
};
