//! `learner doctor`: checks a machine before a run is trusted to it.

use std::net::{Ipv4Addr, TcpListener};
use std::path::Path;
use std::time::Duration;

use quad_policy::Precision;
use quad_protocol::{Name, keys};
use quad_service::doctor::{Findings, certificates, disk, machine, network};
use quad_service::{Endpoints, Role};
use zenoh::Session;

use crate::cli::DoctorArgs;
use crate::datasets;

/// Where evaluators look by default.
const PORT: u16 = 7447;
/// How long other learners are waited for.
const ANSWER: Duration = Duration::from_secs(5);

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
    hdf5(&mut findings);
    disk::folder(&mut findings, "run folder", &args.run_dir, "another folder is chosen by --run-dir");
    match datasets::cache::folder() {
        Ok(folder) => disk::folder(&mut findings, "datasets", &folder, "another folder is chosen by D4RL_DATASET_DIR"),
        Err(error) => findings.warn("datasets", format!("{error:#}"), "name a folder in D4RL_DATASET_DIR"),
    }
    let certificates = args.certificates.as_deref();
    let certificates = certificates.and_then(|folder| certificates::folder(&mut findings, folder, Role::Learner));
    match &args.connect {
        Some(endpoint) => {
            let endpoints = Endpoints { connect: vec![endpoint.clone()], certificates, ..Endpoints::default() };
            router(&mut findings, &endpoints, &args.run_dir)?;
        }
        None => port(&mut findings),
    }
    Ok(findings)
}

fn precision(findings: &mut Findings) {
    findings.ok(
        "precision",
        match Precision::Bf16.is_available() {
            true => "this CPU is faster in bf16: --precision bf16 speeds up training",
            false => "f32: this CPU has neither AMX nor AMD's AVX512-BF16, with which bf16 is faster",
        },
    );
}

fn hdf5(findings: &mut Findings) {
    match quad_dataset::hdf5_library() {
        (version, true) => findings.ok("HDF5", format!("{version}, with compression")),
        (version, false) => findings.fail(
            "HDF5",
            format!("{version} was built without zlib, which D4RL's files need"),
            "install Debian's libhdf5-103-1",
        ),
    }
}

fn router(findings: &mut Findings, endpoints: &Endpoints, run_dir: &Path) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    runtime.block_on(async {
        if let Some(session) = network::reach(findings, endpoints).await {
            if let Some(run) = run_dir.file_name().and_then(|name| Name::new(name.to_str()?).ok()) {
                namesake(findings, &session, &run).await;
            }
            session.close().await.ok();
        }
    });
    runtime.shutdown_background();
    Ok(())
}

/// Two learners under one name take each other's jobs and scores.
async fn namesake(findings: &mut Findings, session: &Session, run: &Name) {
    let Ok(tokens) = session.liveliness().get(keys::all_lives(run)).timeout(ANSWER).await else { return };
    match tokens.recv_async().await {
        Ok(reply) if reply.result().is_ok() => findings.fail(
            "run name",
            format!("a learner of run {run} is there already"),
            "wait for its end, or choose another folder by --run-dir: its last part names the run",
        ),
        _ => findings.ok("run name", format!("nobody else is called {run}")),
    }
}

fn port(findings: &mut Findings) {
    match TcpListener::bind((Ipv4Addr::LOCALHOST, PORT)) {
        Ok(_) => findings.ok("port", format!("tcp/127.0.0.1:{PORT} is free for the learner to listen at")),
        Err(error) => findings.warn(
            "port",
            format!("tcp/127.0.0.1:{PORT} cannot be listened at: {error}"),
            "if another learner has it, choose a free one by --listen tcp/127.0.0.1:0, or a router by --connect",
        ),
    }
}
