//! `evaluator doctor`: checks this machine before it evaluates anything.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use quad_dataset::environment;
use quad_policy::{ActionNoise, Precision};
use quad_protocol::{CodecError, JobReply, JobRequest, Name, PROTOCOL_VERSION, decode_from, encode, keys};
use quad_service::doctor::{Findings, certificates, machine, network};
use quad_service::{Endpoints, Role, default_endpoint, parse_endpoint};
use zenoh::Session;

use crate::rollout::Rollout;
use crate::serve::{DEFAULT_PORT, take_turn};

/// How long learners are waited for.
const ANSWER: Duration = Duration::from_secs(5);

const AFTER_HELP: &str = "\
A line per check: ok, warn or FAIL, and a hint where there is something to do. The exit code is 1 if anything failed.";

/// Check this machine before it evaluates anything, and say what to do about what is wrong
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct DoctorArgs {
    /// Zenoh endpoint of a learner or a router [default: tcp/127.0.0.1:7447, or tls/… with --certificates]
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint)]
    connect: Option<String>,
    /// Folder with ca.pem, cert.pem and key.pem, for endpoints tls/HOST:PORT (docs/security.md)
    #[arg(long, value_name = "DIR", env = "QUAD_CERTIFICATES")]
    certificates: Option<PathBuf>,
    /// Print a JSON array of objects with verdict, check, what and, where there is something to do, hint
    #[arg(long)]
    pub json: bool,
}

/// Does all checks.
///
/// # Errors
/// The checks cannot be done; what they find is no error.
pub fn examine(args: &DoctorArgs) -> anyhow::Result<Findings> {
    let mut findings = Findings::default();
    machine::threads(&mut findings);
    machine::open_files(&mut findings);
    machine::clock(&mut findings);
    precision(&mut findings);
    simulator(&mut findings);
    let certificates = args.certificates.as_deref();
    let certificates = certificates.and_then(|folder| certificates::folder(&mut findings, folder, Role::Evaluator));
    let endpoint = args.connect.clone().unwrap_or_else(|| default_endpoint(certificates.as_ref(), DEFAULT_PORT));
    let endpoints = Endpoints { connect: vec![endpoint], certificates, ..Endpoints::default() };
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    runtime.block_on(async {
        if let Some(session) = network::reach(&mut findings, &endpoints).await {
            runs(&mut findings, &session).await?;
            session.close().await.map_err(|error| anyhow::anyhow!(error))?;
        }
        anyhow::Ok(())
    })?;
    runtime.shutdown_background();
    Ok(findings)
}

fn precision(findings: &mut Findings) {
    let name = Precision::Bf16.in_effect().name();
    let why = match Precision::Bf16.is_available() {
        true => "this CPU is faster with it",
        false => "this CPU has neither AMX nor AMD's AVX512-BF16, with which bf16 is faster",
    };
    findings.ok("precision", format!("evaluates in {name}: {why}"));
}

/// One step of one episode. Without any libmujoco this program would not have started.
fn simulator(findings: &mut Findings) {
    let version = mujoco_rs::mujoco_version();
    let step = || -> anyhow::Result<()> {
        let mut rollout = Rollout::new(environment::find("hopper")?, 0, &[0], ActionNoise::new)?;
        rollout.step(|_, _, _| Ok(()))
    };
    match step() {
        Ok(()) => findings.ok("libmujoco", format!("{version}, and Hopper moves in it")),
        Err(error) => {
            findings.fail("libmujoco", format!("{version}: {error:#}"), "deploy/setup.sh fetches the right one")
        }
    }
}

/// The runs whose learners are there, and whether each speaks this program's version of the protocol.
async fn runs(findings: &mut Findings, session: &Session) -> anyhow::Result<()> {
    let tokens = session.liveliness().get(keys::ALL_LEARNERS).timeout(ANSWER).await;
    let tokens = tokens.map_err(|error| anyhow::anyhow!(error)).context("cannot look for learners")?;
    let mut found = false;
    while let Ok(reply) = tokens.recv_async().await {
        let Some(run) = reply.result().ok().and_then(|token| keys::run_of(token.key_expr().as_str())) else { continue };
        found = true;
        version(findings, session, &run).await?;
    }
    if !found {
        let hint = "nothing, if the learner starts later: an evaluator waits for it";
        findings.warn("runs", "no learner is there", hint);
    }
    Ok(())
}

/// Asks the run's learner for work in no environment, so that there is none: the answer's version is what counts.
async fn version(findings: &mut Findings, session: &Session, run: &Name) -> anyhow::Result<()> {
    let evaluator = Name::new(format!("doctor-{}", std::process::id()))?;
    let precision = Name::new(Precision::Bf16.arithmetic())?;
    let claim = JobRequest::Claim { evaluator, attempt: rand::random(), environments: Vec::new(), precision };
    let question = encode(&claim)?;
    let key = keys::jobs(run);
    let _turn = take_turn(&key).await;
    let replies = session.get(key).payload(question).timeout(ANSWER).await;
    let replies = replies.map_err(|error| anyhow::anyhow!(error)).context("cannot ask a learner")?;
    let Ok(reply) = replies.recv_async().await else {
        let hint = "is its machine overloaded, or its process stopped? Its log and its /healthz say more";
        findings.fail("run", format!("the learner of run {run} does not answer"), hint);
        return Ok(());
    };
    let update = "update the older of the two programs; both print theirs with --version";
    match reply.result() {
        Ok(sample) => match decode_from::<JobReply>(sample.payload().len(), sample.payload().reader()) {
            Ok(_) => findings
                .ok("run", format!("{run} speaks version {PROTOCOL_VERSION} of the protocol, like this program")),
            Err(error @ CodecError::Version { .. }) => findings.fail("run", format!("{run}: {error}"), update),
            Err(error) => findings.fail("run", format!("{run} answers with no message of ours: {error}"), update),
        },
        // A learner of another version cannot read the question, and says so.
        Err(error) => {
            let text = error.payload().to_bytes();
            let text = String::from_utf8_lossy(&text[..text.len().min(200)]).into_owned();
            findings.fail("run", format!("{run} does not take this program's question: {text}"), update);
        }
    }
    Ok(())
}
