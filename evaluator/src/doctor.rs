//! `evaluator doctor`: checks this machine before it evaluates anything.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use quad_policy::Precision;
use quad_protocol::{JobReply, JobRequest, Name, PROTOCOL_VERSION, decode_from, encode, keys};
use quad_runtime::doctor::{self, Findings};
use quad_runtime::{
    DEFAULT_PORT, Endpoints, Role, certificates_folder, default_endpoint, parse_endpoint,
};
use zenoh::Session;

use crate::sim::{Environments, Rollout, Simulations};
use crate::tools::film::{Gl, INSTALL};

/// The environment of the trial.
const HOPPER: &str = "hopper";
/// How long the check waits for learners.
const ANSWER: Duration = Duration::from_secs(5);

const UPDATE: &str =
    "update the older program (--version tells); if the learner hangs, its log says why";

const AFTER_HELP: &str = "\
The evaluator prints a line per check: ok, warn or FAIL, with a hint if you can do something. The exit code is 1 if a check failed.";

/// Check this machine before it evaluates anything, and say how to fix what is wrong
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct DoctorArgs {
    /// Zenoh endpoint of a learner or a router [default: tcp/127.0.0.1:7447, or tls/… with
    /// --certificates]
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint)]
    connect: Option<String>,
    /// Folder with ca.pem, cert.pem and key.pem, for endpoints tls/HOST:PORT (docs/security.md)
    /// [default: QUAD_CERTIFICATES]
    #[arg(long, value_name = "DIR")]
    certificates: Option<PathBuf>,
    /// Print a JSON array of objects with verdict, check, what and (if you can do something) hint
    #[arg(long)]
    pub json: bool,
}

/// Runs all checks.
///
/// # Errors
/// A check cannot run; a finding is no error.
pub fn examine(args: &DoctorArgs) -> anyhow::Result<Findings> {
    let mut findings = Findings::default();
    doctor::threads(&mut findings);
    let bf16 = match Precision::Bf16.is_available() {
        true => "with --precision bf16 it rounds and is faster",
        false => "this CPU is no faster in bf16",
    };
    findings.ok("precision", format!("evaluates in f32; {bf16}"));
    simulator(&mut findings);
    findings.ok(
        "film",
        Gl::new()
            .map_or_else(|_| format!("cannot be made: {INSTALL}"), |_| "can be made".to_owned()),
    );
    let folder = certificates_folder(args.certificates.clone());
    let certificates =
        folder.and_then(|folder| doctor::certificates(&mut findings, &folder, Role::Evaluator));
    let endpoint = args
        .connect
        .clone()
        .unwrap_or_else(|| default_endpoint(certificates.as_ref(), DEFAULT_PORT));
    let endpoints = Endpoints { connect: vec![endpoint], certificates, ..Endpoints::default() };
    doctor::connected(&mut findings, &endpoints, runs)?;
    Ok(findings)
}

/// Runs one step of one episode. (Without any libmujoco this program would not have started.)
fn simulator(findings: &mut Findings) {
    let version = mujoco_rs::mujoco_version();
    let step = || -> anyhow::Result<()> {
        let sizes = Simulations.sizes(HOPPER).unwrap_or_default();
        let make = || Simulations.make(HOPPER, 0);
        Rollout::new(make, sizes, &[0], |_| ())?.step(|_, _, _| anyhow::Ok(()))?;
        Ok(())
    };
    match step() {
        Ok(()) => findings.ok("libmujoco", format!("{version}, and Hopper moves in it")),
        Err(error) => findings.fail(
            "libmujoco",
            format!("{version}: {error:#}"),
            "deploy/setup.sh fetches 3.17.0",
        ),
    }
}

/// Lists the runs whose learners are connected, and checks that each speaks this program's version
/// of the protocol.
async fn runs(findings: &mut Findings, session: &Session) -> anyhow::Result<()> {
    let tokens = session
        .liveliness()
        .get(keys::ALL_LEARNERS)
        .timeout(ANSWER)
        .await
        .map_err(anyhow::Error::msg)?;
    let mut found = false;
    while let Ok(reply) = tokens.recv_async().await {
        let Some(run) =
            reply.result().ok().and_then(|token| keys::run_of(token.key_expr().as_str()))
        else {
            continue;
        };
        found = true;
        match ask(session, &run).await? {
            None => findings.ok(
                "run",
                format!(
                    "{run} speaks version {PROTOCOL_VERSION} of the protocol, like this program"
                ),
            ),
            Some(problem) => findings.fail("run", format!("{run}: {problem}"), UPDATE),
        }
    }
    if !found {
        findings.warn(
            "runs",
            "no learner is there",
            "if it starts later: an evaluator waits for it",
        );
    }
    Ok(())
}

/// Asks a run's learner for a job in no environment, so that it gives none. Returns what is wrong
/// with the answer.
async fn ask(session: &Session, run: &Name) -> anyhow::Result<Option<String>> {
    let evaluator = Name::new(format!("doctor-{}", std::process::id()))?;
    let claim = encode(&JobRequest::Claim {
        evaluator,
        attempt: rand::random(),
        environments: Vec::new(),
    })?;
    let replies = session
        .get(keys::jobs(run))
        .payload(claim)
        .timeout(ANSWER)
        .await
        .map_err(anyhow::Error::msg)?;
    let Ok(reply) = replies.recv_async().await else {
        return Ok(Some(format!("its learner gives no answer within {ANSWER:?}")));
    };
    Ok(match reply.result() {
        Ok(sample) => {
            let answer = decode_from::<JobReply>(sample.payload().len(), sample.payload().reader());
            answer.err().map(|error| error.to_string())
        }
        // A learner of another version cannot read the claim, and says so.
        Err(error) => {
            Some(String::from_utf8_lossy(&error.payload().to_bytes()).chars().take(200).collect())
        }
    })
}
