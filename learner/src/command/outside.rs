//! Endpoints and evaluators of a run, and the cores that training leaves to them.

use std::num::NonZero;
use std::thread::available_parallelism;

use quad_dataset::environment;
use quad_run::config::Experiment;
use quad_runtime::{
    Certificates, CertificatesError, DEFAULT_PORT, Endpoints, Hint, Role, SessionError,
    certificates_folder, default_endpoint, requested_threads,
};
use tracing::{info, warn};

use crate::children::LocalEvaluators;
use crate::cli::TrainArgs;
use crate::live::{OpeningSession, open_network};

/// Default limit of training threads: a gradient step of the paper is cut into tiles (twenty with
/// one next action per state), and threads that wait for a tile keep their cores busy.
const MOST_THREADS: usize = 16;
const ANY_PORT: u16 = 0;

pub(super) struct Outside {
    pub endpoints: Endpoints,
    pub evaluators: LocalEvaluators,
    /// True if the command line names no endpoint.
    is_default: bool,
    /// True if the learner starts evaluators, which know the endpoint.
    has_evaluators: bool,
}

impl Outside {
    pub fn new(args: &TrainArgs, experiment: &Experiment) -> anyhow::Result<Self> {
        let needs_evaluators = experiment.needs_evaluators();
        if !needs_evaluators && args.evaluators.is_some_and(|count| count > 0) {
            warn!(
                "--evaluators has no effect: the run has neither evaluations nor online episodes"
            );
        }
        let endpoints = endpoints(args, needs_evaluators)?;
        let is_default = args.listen.is_none() && args.connect.is_none();
        let cores = available_parallelism()?.get();
        let is_alone = is_default
            && endpoints.certificates.is_none()
            && environment::find(&experiment.environment).is_ok();
        let (count, share) = match args.evaluators {
            _ if args.dry_run || !needs_evaluators => (0, cores),
            Some(count) => (count, cores),
            None if is_alone => {
                let left = cores.saturating_sub(training_threads()).max(1);
                (left.min(experiment.episodes as usize), left)
            }
            None => (0, cores),
        };
        let evaluators = LocalEvaluators::new(count, share)?;
        Ok(Self { endpoints, evaluators, is_default, has_evaluators: count > 0 })
    }

    /// Starts to open the session. If the usual port cannot be used, as where another learner has
    /// it, a learner that starts evaluators takes a free one.
    pub async fn open(&mut self) -> anyhow::Result<OpeningSession> {
        let mut opening = open_network(&self.endpoints).await;
        if opening.is_err() && self.is_default {
            let endpoint = |port| default_endpoint(self.endpoints.certificates.as_ref(), port);
            if !self.has_evaluators {
                let another = endpoint(DEFAULT_PORT + 1);
                return opening.hint(format!(
                    "where another learner has the port, evaluators without --connect serve that one: give this one \
                     --listen {another}, and its evaluators --connect {another} (in Python connect=\"{another}\")"
                ));
            }
            info!(
                "cannot listen at port {DEFAULT_PORT}, perhaps as a learner does; taking a free one"
            );
            self.endpoints.listen = vec![endpoint(ANY_PORT)];
            opening = open_network(&self.endpoints).await;
        }
        let hint = "join a router with --connect, or listen with --listen";
        opening.hint_of(|error| error.downcast_ref().map_or(hint, SessionError::hint))
    }
}

/// The number of training threads: RAYON_NUM_THREADS, or else one per core, up to a limit.
pub(super) fn training_threads() -> usize {
    let cores = available_parallelism().map_or(1, NonZero::get);
    requested_threads().map_or(cores.min(MOST_THREADS), NonZero::get)
}

fn endpoints(args: &TrainArgs, needs_evaluators: bool) -> anyhow::Result<Endpoints> {
    // A learner that starts evaluators uses no certificates: the variable is for other networks.
    let has_evaluators = args.evaluators.is_some_and(|count| count > 0);
    let folder = certificates_folder(args.certificates.clone()).filter(|_| !has_evaluators);
    let certificates = folder.map(|folder| Certificates::read(&folder, Role::Learner));
    let certificates = certificates.transpose().hint_of(CertificatesError::hint)?;
    let port = if needs_evaluators { DEFAULT_PORT } else { ANY_PORT };
    let listen = match (&args.listen, &args.connect) {
        (None, None) => vec![default_endpoint(certificates.as_ref(), port)],
        (listen, _) => Vec::from_iter(listen.clone()),
    };
    let connect = Vec::from_iter(args.connect.clone());
    let endpoints = Endpoints { listen, connect, certificates };
    endpoints.check().hint_of(SessionError::hint)?;
    if let Some(endpoint) = endpoints.open_to_all() {
        warn!(
            "every machine that reaches {endpoint} may read weights and send scores: in a network that you do not trust, use \
             --certificates DIR (docs/security.md)"
        );
    }
    Ok(endpoints)
}
