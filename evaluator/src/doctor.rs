//! `evaluator doctor`: checks this machine before it evaluates anything.

use std::path::PathBuf;

use clap::Args;
use quad_dataset::environment;
use quad_policy::Precision;
use quad_protocol::{Name, PROTOCOL_VERSION, keys};
use quad_runtime::doctor::{self, Findings};
use quad_runtime::{
    DEFAULT_PORT, Endpoints, Role, certificates_folder, default_endpoint, parse_endpoint,
};
use zenoh::Session;

use crate::metrics::Metrics;
use crate::serve::{ANSWER_TIMEOUT, Connection, QueryError};
use crate::sim;
use crate::tools::film::{Gl, INSTALL};

const UPDATE: &str = "update the older program (see --version); if the learner hangs, see its log";

const AFTER_HELP: &str = "\
The evaluator prints a line per check: ok, warn or FAIL, with a hint if there is something to do. The exit code is 1 if a check failed.";

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

/// Runs all checks. Fails if a check cannot run; a finding is no error.
pub fn examine(args: &DoctorArgs) -> anyhow::Result<Findings> {
    let mut findings = Findings::default();
    doctor::threads(&mut findings);
    let bf16 = match Precision::Bf16.is_available() {
        true => "with --precision bf16 it rounds and is faster",
        false => "this CPU is no faster in bf16",
    };
    findings.ok("precision", format!("evaluates in f32; {bf16}"));
    simulator(&mut findings);
    let film = match Gl::new() {
        Ok(_) => "can be made".to_owned(),
        Err(_) => format!("cannot be made: {INSTALL}"),
    };
    findings.ok("film", film);
    let folder = certificates_folder(args.certificates.clone());
    let certificates =
        folder.and_then(|folder| doctor::certificates(&mut findings, &folder, Role::Evaluator));
    let default = || default_endpoint(certificates.as_ref(), DEFAULT_PORT);
    let connect = vec![args.connect.clone().unwrap_or_else(default)];
    let endpoints = Endpoints { connect, certificates, ..Endpoints::default() };
    doctor::connected(&mut findings, &endpoints, runs)?;
    Ok(findings)
}

/// Simulates one step. Without any libmujoco this program would not have started.
fn simulator(findings: &mut Findings) {
    let version = mujoco_rs::mujoco_version();
    let step = || -> anyhow::Result<()> {
        let mut hopper = sim::make(environment::find("hopper")?, 0)?;
        hopper.reset(0);
        hopper.step(&[0.0; 3]);
        Ok(())
    };
    match step() {
        Ok(()) => findings.ok("libmujoco", format!("{version} simulates Hopper")),
        Err(error) => {
            let problem = format!("{version}: {error:#}");
            findings.fail("libmujoco", problem, "deploy/setup.sh fetches 3.17.0");
        }
    }
}

/// Lists the runs whose learners are connected, and checks that each speaks this program's version
/// of the protocol.
async fn runs(findings: &mut Findings, session: &Session) -> anyhow::Result<()> {
    let tokens = session.liveliness().get(keys::ALL_LEARNERS).timeout(ANSWER_TIMEOUT);
    let tokens = tokens.await.map_err(anyhow::Error::msg)?;
    let mut count = 0;
    while let Ok(reply) = tokens.recv_async().await {
        let Ok(token) = reply.result() else { continue };
        let key = token.key_expr().as_str();
        let ids = keys::run_of(key).zip(keys::incarnation_of(key));
        let Some((run, incarnation)) = ids else { continue };
        count += 1;
        match problem(session, run.clone(), incarnation).await? {
            None => {
                let version = format!("version {PROTOCOL_VERSION} of the protocol");
                findings.ok("run", format!("{run} speaks {version}, like this program"));
            }
            Some(problem) => findings.fail("run", format!("{run}: {problem}"), UPDATE),
        }
    }
    if count == 0 {
        let hint = "an evaluator waits for learners that start later";
        findings.warn("runs", "no learner is connected", hint);
    }
    Ok(())
}

/// Claims a job in no environment, so that the run's learner gives none. Returns the fault of the
/// answer.
async fn problem(session: &Session, run: Name, incarnation: u64) -> anyhow::Result<Option<String>> {
    let evaluator = Name::new(format!("doctor-{}", std::process::id()))?;
    let (session, metrics) = (session.clone(), Metrics::new()?);
    let connection = Connection { run, evaluator, session, metrics, incarnation };
    Ok(match connection.claim(rand::random(), Vec::new()).await {
        Ok(_) => None,
        Err(QueryError::NoAnswer(_)) => {
            Some(format!("its learner has not answered within {ANSWER_TIMEOUT:?}"))
        }
        // A learner of another version answers with an error.
        Err(QueryError::Unusable { reason, .. }) => Some(reason),
        Err(error) => Some(error.to_string()),
    })
}
