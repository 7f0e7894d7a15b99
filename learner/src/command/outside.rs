//! A run's connections: where it meets evaluators, and the evaluators that it starts itself.

use std::thread::available_parallelism;

use quad_runtime::{
    Certificates, CertificatesError, DEFAULT_PORT, Endpoints, Hint, Role, SessionError, default_endpoint,
};
use tracing::{info, warn};

use crate::cli::TrainArgs;
use crate::live::{Opening, open_network};
use crate::local_evaluators::LocalEvaluators;

/// For a run that needs no known port, so that several can run at a time.
const ANY_PORT: u16 = 0;

/// What the command line asks for.
pub(super) struct Outside {
    /// Where the learner listens or connects.
    pub endpoints: Endpoints,
    /// The evaluators that the learner starts.
    pub evaluators: LocalEvaluators,
    /// Whether the command line does not say where to listen.
    is_default: bool,
}

impl Outside {
    /// Reads the command line.
    ///
    /// # Errors
    /// Endpoints or certificates that cannot be used, or no `evaluator` program to start.
    pub fn new(args: &TrainArgs, eval_interval: u64) -> anyhow::Result<Self> {
        Ok(Self {
            endpoints: endpoints(args, eval_interval)?,
            evaluators: LocalEvaluators::new(args.evaluators, available_parallelism()?.get())?,
            is_default: args.listen.is_none() && args.connect.is_none(),
        })
    }

    /// Starts to open the session. If another learner on this machine has the usual port, it takes a free one.
    ///
    /// # Errors
    /// The learner cannot listen.
    pub async fn open(&mut self) -> anyhow::Result<Opening> {
        let mut opening = open_network(&self.endpoints).await;
        if opening.is_err() && self.is_default {
            info!("another program, perhaps a learner, has port {DEFAULT_PORT}; taking a free one");
            self.endpoints.listen = vec![default_endpoint(self.endpoints.certificates.as_ref(), ANY_PORT)];
            opening = open_network(&self.endpoints).await;
        }
        opening.hint_of(|error| {
            error.downcast_ref().map_or("join a router with --connect, or listen with --listen", SessionError::hint)
        })
    }
}

/// Where the learner listens or connects.
fn endpoints(args: &TrainArgs, eval_interval: u64) -> anyhow::Result<Endpoints> {
    let certificates = args.certificates.as_deref().map(|folder| Certificates::read(folder, Role::Learner));
    let certificates = certificates.transpose().hint_of(CertificatesError::hint)?;
    let port = if eval_interval == 0 { ANY_PORT } else { DEFAULT_PORT };
    let listen = match (&args.listen, &args.connect) {
        (None, None) => vec![default_endpoint(certificates.as_ref(), port)],
        (listen, _) => Vec::from_iter(listen.clone()),
    };
    let endpoints = Endpoints { listen, connect: Vec::from_iter(args.connect.clone()), certificates };
    endpoints.check().hint_of(SessionError::hint)?;
    if let Some(endpoint) = endpoints.open_to_all() {
        warn!(
            "every machine that reaches {endpoint} may read weights and send scores: in a network that you do not trust, use \
             --certificates DIR (docs/security.md)"
        );
    }
    Ok(endpoints)
}
