//! `evaluator serve`: finds runs, evaluates the snapshots that they publish, delivers the scores.
//!
//! # Layout
//!
//! In reading order:
//!
//! - `discovery`: finds the runs, by their learners' liveliness tokens.
//! - `worker`: the main loop, which serves the runs in turn; `turns`: whose turn it is.
//! - `run`: everything that is exchanged with the learner of one run; `query`: a query to a learner; `hand_back`: a job that
//!   is not done goes back.
//! - `snapshots`: keeps the newest snapshot of a run, within a `budget`; `loading`: makes a policy of one.
//! - `job`: all episodes of a job, as one batch.
//!
//! An evaluator has no state that must last. When it is told to leave, it hands its job back; if it is killed, the job goes to
//! another evaluator when the lease runs out.

mod budget;
mod discovery;
mod hand_back;
mod job;
mod loading;
mod query;
mod run;
mod snapshots;
mod turns;
mod worker;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::PoisonError;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use quad_policy::Precision;
use quad_protocol::Name;
use quad_service::{
    Certificates, CertificatesError, Endpoints, Health, Hint, Role, SessionError, default_endpoint, parse_endpoint,
};
use rand::Rng;
use tokio::task::JoinSet;
use tracing::{info, warn};

use crate::metrics::Metrics;
use discovery::Discovery;
pub(crate) use query::take_turn;
use worker::Worker;

const AFTER_HELP: &str = "\
Runs are found by themselves, also those that start later; several are served in turn. Stop it at any time
(Ctrl-C or SIGTERM): the job that it had is handed to another evaluator.

Examples:
  evaluator serve                                       the learner of this machine
  evaluator serve --connect tcp/learner.example:7447    a learner or router elsewhere
  evaluator serve --connect tls/learner.example:7447 --certificates certificates/box7    … that asks who comes
  evaluator serve --metrics 127.0.0.1:9101              with http://127.0.0.1:9101/metrics

RAYON_NUM_THREADS bounds the processor cores that are used; without it, all are.";

/// Measure the weights that learners publish, until told to stop
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct ServeArgs {
    /// Zenoh endpoint of a learner or a router; may be given several times
    /// [default: tcp/127.0.0.1:7447, or tls/… with --certificates]
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint)]
    connect: Vec<String>,
    /// Folder with ca.pem, cert.pem and key.pem: who this evaluator is for endpoints like tls/HOST:PORT (docs/security.md)
    #[arg(long, value_name = "DIR", env = "QUAD_CERTIFICATES")]
    certificates: Option<PathBuf>,
    /// Where to serve /metrics and /healthz; port 0 takes a free one
    #[arg(long, value_name = "ADDR:PORT")]
    metrics: Option<SocketAddr>,
    /// Name in scores and metrics, unique among the evaluators of a run [default: HOST-PID-RANDOM]
    #[arg(long, value_parser = |text: &str| Name::new(text))]
    name: Option<Name>,
    /// Arithmetic of the networks, f32 or bf16 [default: bf16 on CPUs that are faster with it, by AMX or AMD's AVX512-BF16]
    #[arg(long, value_name = "NAME")]
    precision: Option<Precision>,
}

/// Where a learner of this machine listens by default.
pub(crate) const DEFAULT_PORT: u16 = 7447;
/// When it is told to stop, it hands its job back within this time.
const HAND_BACK: Duration = Duration::from_secs(2);
/// Then the process waits this long for its threads and for the session to close.
const LEAVE: Duration = Duration::from_secs(1);

/// The worker counts as stuck when it has got nowhere for this long. It waits up to half a minute for weights.
const STUCK: Duration = Duration::from_secs(60);

/// Serves until SIGINT or SIGTERM.
pub fn serve(args: ServeArgs) -> anyhow::Result<()> {
    keep_heap_small();
    // Two threads for the network; episodes run on their own.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .context("cannot start the asynchronous runtime")?;
    let result = runtime.block_on(serve_until_stopped(args));
    runtime.shutdown_timeout(LEAVE);
    result
}

async fn serve_until_stopped(args: ServeArgs) -> anyhow::Result<()> {
    let stop = quad_service::shutdown_signal();
    let metrics = Metrics::new().context("cannot register the metrics")?;
    let name = args.name.map_or_else(unique_name, Ok)?;
    let endpoints = endpoints(args.connect, args.certificates.as_deref())?;
    info!(evaluator = %name, "ready to serve");
    if args.precision.is_some_and(|wanted| !wanted.is_available()) {
        warn!("{}", Precision::UNAVAILABLE);
    }
    let precision = args.precision.unwrap_or(Precision::Bf16);
    let health = Health::default();
    // Serves for as long as it is held.
    let _server = match args.metrics {
        Some(address) => {
            let server = quad_service::serve_metrics(address, metrics.registry.clone(), health.clone())
                .await
                .hint("choose another address or port for --metrics, or port 0 for a free one")?;
            info!("metrics at http://{}/metrics", server.address);
            Some(server)
        }
        None => None,
    };
    let mut discovery = Discovery::start(endpoints.connect, endpoints.certificates.as_ref(), &metrics);
    let worker = Worker::new(name, precision, metrics.clone(), discovery.runs(), health.part("worker", STUCK))?;
    let held = worker.held();
    let mut work = std::pin::pin!(worker.run());
    let result = tokio::select! {
        biased;
        () = stop => Ok(()),
        // Before the worker, which fails as a consequence when this has failed.
        error = discovery.failed() => Err(error),
        error = &mut work => Err(error),
    };
    // While the worker still is there, and with it what announces this evaluator: without, the job would count as lost.
    let jobs = std::mem::take(&mut *held.lock().unwrap_or_else(PoisonError::into_inner));
    let ends = JoinSet::from_iter(jobs.into_values().map(|job| job.send(HAND_BACK)));
    ends.join_all().await;
    let (episodes, steps) = (metrics.episodes.get(), metrics.environment_steps.get());
    info!(episodes, steps, "leaving");
    result
}

fn endpoints(mut connect: Vec<String>, certificates: Option<&Path>) -> anyhow::Result<Endpoints> {
    let certificates = certificates.map(|folder| Certificates::read(folder, Role::Evaluator));
    let certificates = certificates.transpose().hint_of(CertificatesError::hint)?;
    if connect.is_empty() {
        connect.push(default_endpoint(certificates.as_ref(), DEFAULT_PORT));
    }
    let endpoints = Endpoints { connect, certificates, ..Endpoints::default() };
    endpoints.check().hint_of(SessionError::hint)?;
    Ok(endpoints)
}

/// Gives a freed snapshot's memory back to the system at once.
///
/// Left alone, glibc learns from the first freed snapshot to serve the next ones from its heaps, one for each thread,
/// which keep what they once had: with the paper's networks that is the difference between 50 and 150 MB.
fn keep_heap_small() {
    // Snapshots are larger, what a step of a batch needs is smaller.
    const LARGE_BLOCK: i32 = 2 << 20;
    // SAFETY: sets a parameter of the allocator, which may be done at any time.
    unsafe { libc::mallopt(libc::M_MMAP_THRESHOLD, LARGE_BLOCK) };
}

/// Host and process for people, a random part because containers share both.
fn unique_name() -> anyhow::Result<Name> {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let host: String = host.chars().filter(|c| c.is_ascii_alphanumeric() || *c == '-').take(40).collect();
    let host = if host.is_empty() { "evaluator" } else { &host };
    let random: u16 = rand::rng().random();
    Name::new(format!("{host}-{}-{random:04x}", std::process::id())).context("cannot make up a name for this evaluator")
}
