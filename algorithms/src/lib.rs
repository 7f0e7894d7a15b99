//! Learning algorithms, one file each, to be read beside its paper.
//!
//! `definition` is what is known of an algorithm before it runs, `algorithm` all that the learner
//! sees of it at work, `agent` an algorithm at work, saved and loaded, and `values` its values for
//! each task. A new algorithm is a file here, a line in [`ALGORITHMS`] and its values in
//! `presets/`.

#![deny(unsafe_code)]

mod agent;
mod algorithm;
mod align_iql;
mod context;
mod cql;
mod definition;
mod denoising;
mod diffuser;
mod diffusion;
mod dql;
mod dtql;
mod fqe;
mod fql;
mod gaussian;
mod hyperparameters;
mod idql;
mod in_sample;
mod iql;
mod ivr;
mod onestep;
mod parts;
mod phases;
mod pool;
mod quad;
mod random;
mod rebrac;
mod replay;
mod returns;
mod sfbc;
mod squashed;
mod td3;
mod td3bc;
mod train_state;
mod values;
mod xql;

pub use agent::{Agent, StateError};
pub use algorithm::{AgentError, Algorithm, AlgorithmError, Measured};
pub use context::{Context, Minibatch};
pub use definition::{Axis, Definition, Metric, MetricsLine, Reporting, Summary, Variant};
pub use fqe::{Fqe, FqeConfig, Units};
pub use parts::Parts;
pub use values::{Values, fits, merge};

/// All algorithms, the one that learns unless another is asked for first.
pub const ALGORITHMS: [Definition; 15] = [
    quad::DEFINITION,
    iql::DEFINITION,
    align_iql::DEFINITION,
    cql::DEFINITION,
    diffuser::DEFINITION,
    dql::DEFINITION,
    dtql::DEFINITION,
    fql::DEFINITION,
    idql::DEFINITION,
    ivr::DEFINITION,
    onestep::DEFINITION,
    rebrac::DEFINITION,
    sfbc::DEFINITION,
    td3bc::DEFINITION,
    xql::DEFINITION,
];

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod golden;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests;
