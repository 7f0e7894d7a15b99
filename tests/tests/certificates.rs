//! With certificates that do not do, or without any where they are needed, no program starts.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::fs;
use std::path::Path;
use std::process::Command;

use quad_tests::certificates::Certificates;
use quad_tests::process::{assert_refused, binary};
use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, peers};

#[test]
fn what_cannot_be_safe_is_refused_before_anything_starts() {
    let Some(certificates) = Certificates::make() else { return };
    let elsewhere = Certificates::make().unwrap();
    let scratch = Scratch::new();
    let preset = scratch.preset("run", Setting::default());
    // Whatever would start nevertheless is stopped, with exit code 124.
    let start = |program: &str| {
        let mut command = Command::new("timeout");
        command.arg(PATIENCE.as_secs().to_string()).arg(binary(program));
        command
    };
    let learner = |arguments: &[&str]| {
        let mut command = start("learner");
        command.arg("train").arg("--preset").arg(&preset).arg("--dataset").arg(scratch.dataset());
        command.arg("--run-dir").arg(scratch.path().join("run")).args(arguments).output().unwrap()
    };
    let evaluator = |arguments: &[&str]| start("evaluator").arg("serve").args(arguments).output().unwrap();
    let (good, tls) = (certificates.argument("evaluator"), format!("tls/127.0.0.1:{}", free_port()));

    let open = evaluator(&["--connect", "tcp/127.0.0.1:1", "--certificates", &good]);
    assert_refused(&open, "tcp/127.0.0.1:1 would be open to anybody", "tls/HOST:PORT");
    let open = learner(&["--listen", "tcp/127.0.0.1:0", "--certificates", &certificates.argument("learner")]);
    assert_refused(&open, "tcp/127.0.0.1:0 would be open to anybody", "tls/HOST:PORT");
    assert_refused(&evaluator(&["--connect", &tls]), "needs certificates", "--certificates DIR");
    assert_refused(&learner(&["--listen", &tls]), "needs certificates", "--certificates DIR");

    let with = |folder: &Path| evaluator(&["--connect", &tls, "--certificates", folder.to_str().unwrap()]);
    assert_refused(&with(&certificates.of("nowhere")), "nowhere/ca.pem", "certificates.sh");
    assert_refused(&with(&certificates.of("learner")), "is a certificate for quad-learner", "this program's role");
    assert_refused(&with(&certificates.of("expired")), "which is not now", "make a new certificate");
    let mixed = certificates.of("mixed");
    fs::create_dir(&mixed).unwrap();
    for (from, file) in [(&elsewhere, "ca.pem"), (&certificates, "cert.pem"), (&certificates, "key.pem")] {
        fs::copy(from.of("evaluator").join(file), mixed.join(file)).unwrap();
    }
    assert_refused(&with(&mixed), "is of another authority", "ca.pem");
    fs::write(mixed.join("key.pem"), "a secret").unwrap();
    assert_refused(&with(&mixed), "key.pem holds no private key", "ca.pem");
    fs::copy(certificates.of("evaluator").join("ca.pem"), mixed.join("ca.pem")).unwrap();
    fs::copy(certificates.of("monitor").join("key.pem"), mixed.join("key.pem")).unwrap();
    assert_refused(&with(&mixed), "key.pem is not the key of", "ca.pem");
    let swapped = learner(&["--listen", &tls, "--certificates", &good]);
    assert_refused(&swapped, "is a certificate for quad-evaluator", "this program's role");
    assert!(!scratch.path().join("run").exists(), "a refused start leaves a folder behind");

    // The environment variable is the flag, and without an endpoint the default one is protected.
    let mut command = start("evaluator");
    command.arg("serve").env("QUAD_CERTIFICATES", certificates.of("nowhere"));
    assert_refused(&command.output().unwrap(), "nowhere/ca.pem", "certificates.sh");
}

#[test]
fn a_learner_for_others_says_that_its_certificate_names_none_of_them() {
    let Some(certificates) = Certificates::make() else { return };
    let reached = certificates.of("reached");
    peers::certificates(reached.parent().unwrap(), &["learner", "reached", "192.0.2.1"]);
    let scratch = Scratch::new();
    let endless = Setting { steps: 100_000_000, ..Setting::default() };
    let mut number = 0;
    for (certificate, listen, warned) in
        [("learner", "tls/0.0.0.0:0", true), ("learner", "tls/localhost:0", false), ("reached", "tls/0.0.0.0:0", false)]
    {
        number += 1;
        let certificate = certificates.argument(certificate);
        let arguments = ["--listen", listen, "--certificates", &certificate];
        let learner = scratch.learner_with(&format!("run-{number}"), endless, &arguments);
        learner.process.wait_for_log("its metrics at", PATIENCE);
        let log = learner.process.log();
        assert_eq!(log.contains(&format!("{listen} is for other machines, but")), warned, "{log}");
    }
}

#[test]
fn no_authority_is_replaced_and_no_certificate_outlives_it() {
    let Some(certificates) = Certificates::make() else { return };
    let folder = certificates.of("learner").parent().unwrap().to_owned();
    let make = |days: &str| {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/zenoh/certificates.sh");
        Command::new(script).arg("--in").arg(&folder).args(["--days", days, "evaluator", "another"]).output().unwrap()
    };
    let refused = |days: &str, because: &str, advice: &str| {
        let output = make(days);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(1) && said.contains(because) && said.contains(advice), "{said}");
        assert!(!folder.join("another").exists(), "a certificate was made");
    };
    refused("3651", "is not valid for 3651 more days", "ask for fewer");
    for offline in ["ca/key.pem", "ca/ca.pem", "ca"] {
        fs::rename(folder.join(offline), folder.join("offline")).unwrap();
        refused("10", "is there, but not the whole authority", "put them back");
        // A new authority would be in the way.
        fs::rename(folder.join("offline"), folder.join(offline)).unwrap();
    }
    for days in ["3649", "0089"] {
        assert!(make(days).status.success(), "{days} days");
    }
    let authority = |name: &str| fs::read(folder.join(name).join("ca.pem")).unwrap();
    assert_eq!(authority("another"), authority("learner"));
}
