//! `learner doctor`: checks a machine before a run is started on it.

use std::path::{Path, absolute};

use quad_dataset::benchmarks;
use quad_policy::Precision;
use quad_run::folder::Lock;
use quad_runtime::doctor::{self, Findings};
use quad_runtime::{DEFAULT_PORT, Endpoints, Role, certificates_folder};

use crate::cli::DoctorArgs;
use crate::data;

/// A finding is no error; a check that cannot run is.
pub fn examine(args: &DoctorArgs) -> anyhow::Result<Findings> {
    let mut findings = Findings::default();
    doctor::threads(&mut findings);
    let fastest = match Precision::Bf16.is_available() {
        true => "bf16, by --precision bf16",
        false => "f32",
    };
    findings.ok("precision", format!("this CPU is fastest in {fastest}"));
    hdf5(&mut findings);
    let elsewhere = "another folder is chosen by --run-dir";
    doctor::folder(&mut findings, "run folder", &args.run_dir, elsewhere);
    locks(&mut findings, &args.run_dir);
    for benchmark in benchmarks::list() {
        let Some(variable) = &benchmark.cache.variable else { continue };
        let hint =
            format!("{variable} chooses another folder for datasets that are fetched by name");
        let mut checks = Findings::default();
        match data::cache_folder(benchmark) {
            Ok(folder) => doctor::folder(&mut checks, "datasets", &folder, &hint),
            Err(error) => checks.warn("datasets", format!("{error:#}"), &hint),
        }
        findings.append_unneeded(checks);
    }
    let folder = certificates_folder(args.certificates.clone());
    let certificates =
        folder.and_then(|folder| doctor::certificates(&mut findings, &folder, Role::Learner));
    let Some(endpoint) = &args.connect else {
        doctor::port(&mut findings, DEFAULT_PORT);
        return Ok(findings);
    };
    let connect = vec![endpoint.clone()];
    let endpoints = Endpoints { connect, certificates, ..Endpoints::default() };
    doctor::connected(&mut findings, &endpoints, async |_, _| anyhow::Ok(()))?;
    Ok(findings)
}

fn locks(findings: &mut Findings, run_dir: &Path) {
    let path = absolute(run_dir).unwrap_or_else(|_| run_dir.to_owned());
    let folder = path.ancestors().find(|folder| folder.is_dir());
    let folder = folder.unwrap_or(&path);
    let shown = folder.display();
    match Lock::is_possible(folder) {
        Ok(true) => findings.ok("locks", format!("files have locks in {shown}")),
        Ok(false) => {
            let problem = format!("files have no locks in {shown}");
            let hint = "a learner keeps others out by a file scores.host instead: after the end of a host that had it, \
                        remove it";
            findings.warn("locks", problem, hint);
        }
        Err(error) => {
            let problem = format!("{shown}: {error}");
            findings.fail("locks", problem, "choose another --run-dir");
        }
    }
}

fn hdf5(findings: &mut Findings) {
    match quad_dataset::hdf5_library() {
        (version, true) => findings.ok("HDF5", format!("{version}, with compression")),
        (version, false) => {
            let problem = format!("{version}, without zlib");
            findings.fail("HDF5", problem, "install Debian's libhdf5-103-1");
        }
    }
}
