//! With certificates that do not do, or without any where they are needed, no program starts.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use quad_tests::PATIENCE;
use quad_tests::certificates::Certificates;
use quad_tests::process::{assert_refused, binary};
use quad_tests::setting::SHORT;
use quad_tests::system::{Scratch, free_port};

/// A program that is stopped with exit code 124 if it starts nevertheless.
fn start(program: &str) -> Command {
    let mut command = Command::new("timeout");
    command.arg(PATIENCE.as_secs().to_string()).arg(binary(program));
    command
}

fn evaluator(arguments: &[&str]) -> Output {
    start("evaluator").arg("serve").args(arguments).output().unwrap()
}

#[test]
fn endpoints_and_certificates_that_do_not_fit_are_refused() {
    let Some(certificates) = Certificates::make() else { return };
    let scratch = Scratch::new();
    let preset = scratch.preset("run", SHORT);
    let learner = |arguments: &[&str]| {
        let mut command = start("learner");
        command.arg("train").arg("--preset").arg(&preset).arg("--dataset").arg(scratch.dataset());
        command.arg("--run-dir").arg(scratch.path().join("run")).args(arguments).output().unwrap()
    };
    let [ours, evaluators] = ["learner", "evaluator"].map(|role| certificates.argument(role));
    let tls = format!("tls/127.0.0.1:{}", free_port());
    let open = evaluator(&["--connect", "tcp/127.0.0.1:1", "--certificates", &evaluators]);
    assert_refused(&open, "tcp/127.0.0.1:1 would", "tls/HOST:PORT");
    let open = learner(&["--listen", "tcp/127.0.0.1:0", "--certificates", &ours]);
    assert_refused(&open, "tcp/127.0.0.1:0 would", "tls/HOST:PORT");
    assert_refused(&evaluator(&["--connect", &tls]), "needs certificates", "--certificates DIR");
    assert_refused(&learner(&["--listen", &tls]), "needs certificates", "--certificates DIR");
    let swapped = learner(&["--listen", &tls, "--certificates", &evaluators]);
    assert_refused(&swapped, "is a certificate for quad-evaluator", "this program's role");
    assert!(!scratch.path().join("run").exists(), "a refused start leaves a folder behind");
}

#[test]
fn certificates_that_do_not_do_are_refused() {
    let Some(certificates) = Certificates::make() else { return };
    let elsewhere = Certificates::make().unwrap();
    let tls = format!("tls/127.0.0.1:{}", free_port());
    let with =
        |folder: &Path| evaluator(&["--connect", &tls, "--certificates", folder.to_str().unwrap()]);
    assert_refused(&with(&certificates.of("nowhere")), "nowhere/ca.pem", "certificates.sh");
    assert_refused(
        &with(&certificates.of("learner")),
        "is a certificate for quad-learner",
        "this program's role",
    );
    assert_refused(
        &with(&certificates.of("expired")),
        "which is not now",
        "make a new certificate",
    );
    let mixed = certificates.of("mixed");
    fs::create_dir(&mixed).unwrap();
    let take = |from: &Certificates, role: &str, file: &str| {
        fs::copy(from.of(role).join(file), mixed.join(file)).unwrap();
    };
    take(&elsewhere, "evaluator", "ca.pem");
    take(&certificates, "evaluator", "cert.pem");
    take(&certificates, "evaluator", "key.pem");
    assert_refused(&with(&mixed), "is of another authority", "ca.pem");
    fs::write(mixed.join("key.pem"), "a secret").unwrap();
    assert_refused(&with(&mixed), "key.pem holds no private key", "ca.pem");
    take(&certificates, "evaluator", "ca.pem");
    take(&certificates, "monitor", "key.pem");
    assert_refused(&with(&mixed), "key.pem is not the key of", "ca.pem");
}

#[test]
fn no_authority_is_replaced_and_no_certificate_outlives_it() {
    let Some(certificates) = Certificates::make() else { return };
    let folder = certificates.of("learner").parent().unwrap().to_owned();
    let make = |days: &str| {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/zenoh/certificates.sh");
        Command::new(script)
            .arg("--in")
            .arg(&folder)
            .args(["--days", days, "evaluator", "another"])
            .output()
            .unwrap()
    };
    let refused = |days: &str, because: &str, advice: &str| {
        let output = make(days);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(
            output.status.code() == Some(1) && said.contains(because) && said.contains(advice),
            "{said}"
        );
        assert!(!folder.join("another").exists(), "a certificate was made");
    };
    refused("3651", "is not valid for 3651 more days", "ask for fewer");
    fs::rename(folder.join("ca/key.pem"), folder.join("offline")).unwrap();
    refused("10", "is there, but not the whole authority", "put them back");
    fs::rename(folder.join("offline"), folder.join("ca/key.pem")).unwrap();
    assert!(make("3649").status.success());
    let authority = |name: &str| fs::read(folder.join(name).join("ca.pem")).unwrap();
    assert_eq!(authority("another"), authority("learner"));
}
