//! Learning algorithms, one file each, to be read beside its paper.
//!
//! # Layout
//!
//! - [`Definition`]: an algorithm before it runs, a line of [`ALGORITHMS`]; [`Values`]: its presets.
//! - [`Algorithm`]: the interface to the learner; [`Agent`]: an algorithm in training;
//!   [`Examples`]: what it learns from, in [`Batch`]es with the columns that it asks for.
//! - `networks`: networks with optimizers and targets, which an algorithm declares once;
//!   `state_dict`; `losses`; `hyperparameters`: types that check themselves; `random`; `context`:
//!   the settings of a run. `prelude` has the names of these for an algorithm's file.
//! - `returns` of recorded episodes; `fqe`: the value of a policy, by the data alone; `replay`:
//!   updates as CUDA graphs of their inputs; `pool`: threads that stay awake during an update.
//! - TD3+BC and ReBRAC share `td3`; IQL, IVR and XQL `in_sample`; CQL, DTQL and RLPD `squashed`;
//!   QUAD, Diffusion-QL, AlignIQL and IDQL `diffusion`; `gaussian` is a policy of several. `fql` is
//!   the one to read first; `qc` shares its flow, `diffusion_policy` QUAD's noise predictor, and SAC
//!   is `rlpd` with other values.
//!
//! CONTRIBUTING.md says what a new algorithm needs.

#![deny(unsafe_code)]

mod agent;
mod algorithm;
mod align_iql;
mod batch;
mod context;
mod cql;
mod definition;
mod diffuser;
mod diffusion;
mod diffusion_policy;
mod dql;
mod dtql;
mod error;
mod examples;
mod fqe;
mod fql;
mod gaussian;
mod hyperparameters;
mod idql;
mod in_sample;
mod iql;
mod ivr;
mod losses;
mod networks;
mod onestep;
mod pool;
mod prelude;
mod qc;
mod quad;
mod random;
mod rebrac;
mod replay;
mod returns;
mod rlpd;
mod sfbc;
mod squashed;
mod state_dict;
mod td3;
mod td3bc;
mod values;
mod xql;

pub use agent::{Agent, StateError};
pub use algorithm::Algorithm;
pub use batch::Batch;
pub use context::Context;
pub use definition::{Axis, Definition, Metric, MetricsLine, Start, Summary, Variant};
pub use error::{AgentError, AlgorithmError, in_words};
pub use examples::{Columns, Examples, Plans};
pub use fqe::{Fqe, FqeConfig, Units};
pub use losses::Measured;
pub use state_dict::StateDict;
pub use values::{Values, fits, merge};

/// All algorithms, the default first.
pub const ALGORITHMS: &[Definition] = &[
    quad::DEFINITION,
    iql::DEFINITION,
    align_iql::DEFINITION,
    cql::DEFINITION,
    diffuser::DEFINITION,
    diffusion_policy::DEFINITION,
    dql::DEFINITION,
    dtql::DEFINITION,
    fql::DEFINITION,
    idql::DEFINITION,
    ivr::DEFINITION,
    onestep::DEFINITION,
    qc::DEFINITION,
    rebrac::DEFINITION,
    rlpd::DEFINITION,
    rlpd::SAC,
    sfbc::DEFINITION,
    td3bc::DEFINITION,
    xql::DEFINITION,
];

#[cfg(test)]
mod golden;
#[cfg(test)]
mod tests;
