//! Serving: finds runs, evaluates the snapshots that their learners publish and plays online episodes with them,
//! delivers scores and experience.
//!
//! Owns the sessions, one for each endpoint, and the state of all communication with learners,
//! which need not last. One task on the main thread does the work in turn. A job's episodes run on
//! their own thread and on rayon's, blocking calls of Zenoh on tokio's, and Zenoh's threads decode
//! messages. An evaluator that leaves hands its job back; the learner gives the job of a killed one
//! to another when the lease ends.
//!
//! # Layout
//!
//! In reading order:
//!
//! - `discovery`: finds the runs, by their learners' liveliness tokens.
//! - `worker`: the main loop, which serves the runs in turn; `scheduler`: chooses the next run.
//! - `duty`: the state machine of one run, without input or output: jobs claimed, results kept;
//!   `client`: does what it says; `connection`: requests to the learner.
//! - `snapshot`: keeps the newest snapshots.
//! - `evaluate`: one job, from its policy to its results; `job`: all of its episodes, as one batch;
//!   `exploration`: the actions of online episodes; `delivery`: the results, as they are delivered.

mod client;
mod connection;
pub mod delivery;
mod discovery;
pub mod duty;
mod evaluate;
pub(crate) mod exploration;
#[cfg(test)]
pub(crate) mod fixtures;
mod job;
pub mod scheduler;
mod snapshot;
mod worker;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use quad_policy::Precision;
use quad_protocol::Name;
use quad_runtime::{
    Certificates, CertificatesError, DEFAULT_PORT, Endpoints, Health, Hint, ListenError, Role,
    SessionError, default_endpoint, parse_address, parse_endpoint, serve_metrics,
};
use tracing::{info, warn};

use crate::metrics::Metrics;
use crate::sim::Environments;
pub(crate) use connection::{ANSWER_TIMEOUT, Connection, QueryError};
use discovery::Discovery;
use evaluate::Evaluator;
use worker::Worker;

const AFTER_HELP: &str = "\
The evaluator finds all runs at its endpoints, also runs that start later, and serves them in turn. You may stop it at any time
(Ctrl-C, SIGTERM, SIGHUP or SIGUSR1): the learner gives its job to another evaluator.

Examples:
  # For a learner on this machine.
  evaluator serve

  # For a learner or router elsewhere, without and with TLS.
  evaluator serve --connect tcp/learner.example:7447
  evaluator serve --connect tls/learner.example:7447 --certificates certificates/box7

RAYON_NUM_THREADS sets the number of processor cores; the default is all.";

/// Evaluate the snapshots that learners publish, until stopped
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct ServeArgs {
    /// Zenoh endpoint of a learner or a router; may be given several times
    /// [default: tcp/127.0.0.1:7447, or tls/… with --certificates]
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint)]
    pub connect: Vec<String>,
    /// Folder with ca.pem, cert.pem and key.pem, for endpoints tls/HOST:PORT (docs/security.md)
    /// [default: QUAD_CERTIFICATES]
    #[arg(long, value_name = "DIR")]
    pub certificates: Option<PathBuf>,
    /// Address of /metrics and /healthz; port 0 takes a free one
    #[arg(long, value_name = "ADDR:PORT", value_parser = parse_address)]
    pub http: Option<SocketAddr>,
    /// Further names of that address, such as a service's: evaluator,evaluator.lab.svc.cluster.local
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    pub http_hosts: Vec<String>,
    /// Name in scores and metrics, unique among the evaluators of a run [default: HOST-PID-RANDOM]
    #[arg(long, value_parser = |text: &str| Name::new(text))]
    pub name: Option<Name>,
    /// Precision of the networks: f32, or bf16, which rounds and is faster on CPUs with AMX or
    /// AMD's AVX512-BF16
    #[arg(long, value_name = "NAME", default_value = "f32")]
    pub precision: Precision,
}

/// Time that the process waits for its threads at the end.
const LEAVE: Duration = Duration::from_secs(1);

/// The evaluator counts as stuck after this long without progress. It waits up to half a minute for
/// weights.
const STUCK: Duration = Duration::from_secs(60);

/// Serves these environments until a signal to end.
pub fn serve(args: ServeArgs, environments: Arc<dyn Environments>) -> anyhow::Result<()> {
    keep_heap_small();
    // Two threads for the network; episodes run on their own.
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    let runtime = builder.worker_threads(2).enable_all().build();
    let runtime = runtime.context("cannot start the asynchronous runtime")?;
    let result = runtime.block_on(serve_until_stopped(args, environments));
    runtime.shutdown_timeout(LEAVE);
    result
}

async fn serve_until_stopped(
    args: ServeArgs,
    environments: Arc<dyn Environments>,
) -> anyhow::Result<()> {
    let stop = quad_runtime::shutdown_signal(quad_runtime::LEAVE_WITHIN);
    let metrics = Metrics::new().context("cannot register the metrics")?;
    let name = args.name.map_or_else(unique_name, Ok)?;
    let endpoints = endpoints(args.connect, args.certificates.as_deref())?;
    info!(evaluator = %name, "ready to serve");
    if !args.precision.is_available() {
        warn!("{}", Precision::UNAVAILABLE);
    }
    let health = Health::default();
    let mut server = None;
    if let Some(address) = args.http {
        let (registry, health) = (metrics.registry.clone(), health.clone());
        let hosts = &args.http_hosts;
        let serving = serve_metrics(address, hosts, registry, health, Default::default()).await;
        let serving = serving.hint_of(ListenError::hint)?;
        info!("metrics at http://{}/metrics", serving.address);
        server = Some(serving);
    }
    let mut discovery = Discovery::start(&endpoints, &metrics);
    let evaluator = Evaluator {
        name,
        environments,
        precision: args.precision,
        metrics: metrics.clone(),
        policy: None,
        beat: health.register("worker", STUCK),
    };
    let worker = Worker::new(evaluator, discovery.runs());
    let end = async {
        tokio::select! {
            biased;
            () = stop => Ok(()),
            error = discovery.failed() => Err(error),
        }
    };
    let result = worker.run(end).await;
    let (episodes, steps) = (metrics.episodes.get(), metrics.environment_steps.get());
    info!(episodes, steps, "leaving");
    drop(server);
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
/// By default, glibc serves snapshots after the first from heaps that never shrink: with the paper's
/// networks the process then has 150 MB instead of 50.
fn keep_heap_small() {
    // Snapshots are larger than this; what a step of a batch needs is smaller.
    const LARGE_BLOCK: i32 = 2 << 20;
    // SAFETY: sets a parameter of the allocator, which may be done at any time.
    unsafe { libc::mallopt(libc::M_MMAP_THRESHOLD, LARGE_BLOCK) };
}

/// Host and process for people, and a random part, because containers may share both.
fn unique_name() -> anyhow::Result<Name> {
    let mut host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    host.retain(|c| c.is_ascii_alphanumeric() || c == '-');
    host.truncate(40);
    let host = if host.is_empty() { "evaluator" } else { &host };
    let random: u16 = rand::random();
    Name::new(format!("{host}-{}-{random:04x}", std::process::id()))
        .context("cannot generate a name for this evaluator")
}
