//! `learner doctor` and `evaluator doctor`, on machines that are well and on ones that are not.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Output};

use quad_protocol::{Name, keys};
use quad_tests::process::binary;
use quad_tests::router::router;
use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, peers};
use serde_json::Value;

fn doctor(program: &str, arguments: &[&str]) -> Output {
    let mut command = Command::new(binary(program));
    command.arg("doctor").args(arguments).env_remove("RAYON_NUM_THREADS").env_remove("QUAD_CERTIFICATES");
    command.env("D4RL_DATASET_DIR", std::env::temp_dir()).output().unwrap()
}

/// What it printed, and whether it found nothing that fails; the exit code must agree.
fn findings(output: &Output) -> (String, bool) {
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let failed = text.lines().any(|line| line.starts_with("FAIL  "));
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(failed.into()), "{text}\n{said}");
    assert!(!failed || said.contains("checks failed"), "{said}");
    (text, !failed)
}

/// The line of a check that came out so, and its hint.
fn line<'a>(text: &'a str, verdict: &str, check: &str) -> &'a str {
    let start = format!("{verdict:4}  {check} ");
    let at = text.lines().position(|line| line.starts_with(&start));
    let at = at.unwrap_or_else(|| panic!("there is no line {start:?} in:\n{text}"));
    let from: usize = text.lines().take(at).map(|line| line.len() + 1).sum();
    let length = text[from..].match_indices('\n').find(|(end, _)| !text[from + end + 1..].starts_with("      hint: "));
    &text[from..from + length.map_or(text.len() - from, |(end, _)| end)]
}

#[test]
fn a_machine_that_is_well() {
    let scratch = Scratch::new();
    let endless = Setting { steps: 100_000_000, eval_interval: 1_000_000, ..Setting::default() };
    let learner = scratch.learner("well", endless);
    let endpoint = learner.endpoint();
    let (text, well) = findings(&doctor("evaluator", &["--connect", &endpoint]));
    assert!(well, "{text}");
    assert!(line(&text, "ok", "connection").contains(&endpoint));
    assert!(line(&text, "ok", "run").contains("well speaks version "));
    assert!(line(&text, "ok", "libmujoco").contains("3.17.0, and Hopper moves in it"));
    line(&text, "ok", "precision");
    assert!(line(&text, "ok", "clock").contains("this program is older"));

    let folder = scratch.path().join("another");
    let (text, well) = findings(&doctor("learner", &["--run-dir", folder.to_str().unwrap()]));
    assert!(well, "{text}");
    assert!(line(&text, "ok", "run folder").contains("GiB free"));
    assert!(line(&text, "ok", "HDF5").contains("with compression"));
    assert!(line(&text, "ok", "clock").contains("this program is older"));
    assert!(line(&text, "ok", "file times").contains("no file from the future"));
    assert!(!folder.exists(), "the doctor makes no folder");

    let output = doctor("evaluator", &["--json", "--connect", &endpoint]);
    let list: Vec<Value> = serde_json::from_slice(&output.stdout).unwrap();
    assert!(list.len() > 4 && list.iter().all(|finding| finding["verdict"] != "fail"), "{list:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_name_that_is_taken() {
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let _session = router(&endpoint).await;
    let endless = Setting { steps: 100_000_000, eval_interval: 1_000_000, ..Setting::default() };
    let _learner = scratch.learner_with("taken", endless, &["--connect", &endpoint]);
    let examine = |run: &str| {
        let folder = scratch.path().join("elsewhere").join(run);
        findings(&doctor("learner", &["--connect", &endpoint, "--run-dir", folder.to_str().unwrap()]))
    };
    eventually("the learner is seen", PATIENCE, || {
        let (text, well) = examine("taken");
        (!well && line(&text, "FAIL", "run name").contains("taken is there already")).then_some(())
    });
    let (text, well) = examine("free");
    assert!(well, "{text}");
}

#[test]
fn nobody_to_connect_to() {
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    for program in ["learner", "evaluator"] {
        let (text, well) = findings(&doctor(program, &["--connect", &endpoint]));
        assert!(!well, "{text}");
        let line = line(&text, "FAIL", "connection");
        assert!(line.contains("refused") && line.contains("\n      hint: that machine is there"), "{line}");
    }
    // It accepts, and never says a word.
    let mute = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("tcp/{}", mute.local_addr().unwrap());
    let (text, well) = findings(&doctor("evaluator", &["--connect", &endpoint]));
    assert!(!well && line(&text, "FAIL", "connection").contains("no Zenoh session"), "{text}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_learner_of_another_version() {
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let run = Name::new("future").unwrap();
    let answer = [&b"QUAD"[..], &999u16.to_le_bytes(), &[3, 0, 0, 0, 0]].concat();
    let jobs = keys::jobs(&run);
    let queryable = session.declare_queryable(&jobs).callback(move |query| {
        zenoh::Wait::wait(query.reply(query.key_expr().clone(), answer.clone())).unwrap();
    });
    let _queryable = queryable.await.unwrap();
    let _token = session.liveliness().declare_token(keys::live_learner(&run, 1)).await.unwrap();
    let output = tokio::task::spawn_blocking(move || doctor("evaluator", &["--connect", &endpoint])).await.unwrap();
    let (text, well) = findings(&output);
    let line = line(&text, "FAIL", "run");
    assert!(!well && line.contains("protocol version 999") && line.contains("hint: update"), "{text}");
}

#[test]
fn folders_that_cannot_be_written_to() {
    let (text, well) = findings(&doctor("learner", &["--run-dir", "/proc/runs/a"]));
    assert!(!well && line(&text, "FAIL", "run folder").contains("/proc/runs/a"), "{text}");

    // A disk of 64 KiB, in a mount namespace of its own.
    let folder = tempfile::tempdir().unwrap();
    let script = format!(
        "mount -t tmpfs -o size=64k tmpfs '{0}' || exit 99; exec '{1}' doctor --run-dir '{0}/run'",
        folder.path().display(),
        binary("learner").display()
    );
    let output = Command::new("unshare").args(["--user", "--map-root-user", "--mount", "sh", "-c", &script]).output();
    match output {
        Ok(output) if output.status.code().is_some_and(|code| code < 2) && !output.stdout.is_empty() => {
            let (text, well) = findings(&output);
            let line = line(&text, "FAIL", "run folder");
            assert!(!well && line.contains("No space left") && line.contains("hint: make room"), "{text}");
        }
        other => eprintln!("the full disk is left out: no file system can be mounted here: {other:?}"),
    }
}

#[test]
fn thread_settings_that_slow_down() {
    let run = |threads: &str| {
        let mut command = Command::new(binary("learner"));
        command.args(["doctor", "--run-dir"]).arg(std::env::temp_dir());
        findings(&command.env("RAYON_NUM_THREADS", threads).output().unwrap()).0
    };
    assert!(line(&run("100000"), "warn", "threads").contains("RAYON_NUM_THREADS is 100000"));
    line(&run("1"), "ok", "threads");
}

/// Certificates by openssl: an authority, and one signed by it that is good for some days.
struct Certificates {
    folder: tempfile::TempDir,
}

impl Certificates {
    fn make(role: &str, days: i32) -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("extensions"), "basicConstraints = CA:FALSE").unwrap();
        let request = "req -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes";
        for line in [
            format!("{request} -x509 -keyout ca.key -out ca.pem -days 3650 -subj /CN=authority"),
            format!("{request} -keyout key.pem -out request.pem -subj /CN=quad-{role}"),
            format!(
                "x509 -req -in request.pem -CA ca.pem -CAkey ca.key -CAcreateserial -extfile extensions -out cert.pem -days {days}"
            ),
        ] {
            let command = Command::new("openssl").args(line.split(' ')).current_dir(folder.path()).output();
            let Ok(output) = command else {
                eprintln!("left out: there is no openssl");
                return None;
            };
            assert!(output.status.success(), "{line}: {}", String::from_utf8_lossy(&output.stderr));
        }
        Some(Self { folder })
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }

    /// What the learner's doctor says of them.
    fn examine(&self) -> (String, bool) {
        let run_dir = self.path().to_str().unwrap();
        findings(&doctor("learner", &["--run-dir", run_dir, "--certificates", run_dir]))
    }
}

#[test]
fn good_certificates() {
    let Some(good) = Certificates::make("learner", 365) else { return };
    let (text, well) = good.examine();
    assert!(well, "{text}");
    assert!(line(&text, "ok", "certificate").contains("CN=quad-learner: good until "));
    for check in ["authority", "private key", "signature"] {
        line(&text, "ok", check);
    }
    let (text, well) = Certificates::make("evaluator", 365).unwrap().examine();
    assert!(!well && line(&text, "FAIL", "role").contains("for quad-evaluator, not for quad-learner"), "{text}");
}

#[test]
fn hosts_of_a_certificate_and_an_authority_that_is_being_replaced() {
    let Some(made) = quad_tests::certificates::Certificates::make() else { return };
    let examine =
        |name: &str| findings(&doctor("learner", &["--run-dir", "run", "--certificates", &made.argument(name)]));
    let (text, _) = examine("learner");
    let certificate = line(&text, "ok", "certificate");
    assert!(
        certificate.contains("no other machine could") && certificate.ends_with("names localhost, 127.0.0.1"),
        "{text}"
    );
    let folder = made.of("reached").parent().unwrap().to_owned();
    peers::certificates(&folder, &["learner", "reached", "learner.example", "192.0.2.1", "2001:db8::1"]);
    let (text, _) = examine("reached");
    let certificate = line(&text, "ok", "certificate");
    assert!(certificate.contains("others could connect"), "{text}");
    assert!(certificate.contains("127.0.0.1, learner.example, 192.0.2.1, 2001:db8::1"), "{text}");

    let new = Certificates::make("learner", 365).unwrap();
    let authorities = |folder: &Path| std::fs::read(folder.join("ca.pem")).unwrap();
    let [old, new] = [authorities(&made.of("reached")), authorities(new.path())];
    for both in [[&old[..], &new].concat(), [&new[..], &old].concat()] {
        std::fs::write(made.of("reached").join("ca.pem"), both).unwrap();
        let (text, well) = examine("reached");
        assert!(well && text.contains("CN=authority: trusted besides"), "{text}");
        assert!(quad_service::Certificates::read(&made.of("reached"), quad_service::Role::Learner).is_ok());
    }
}

#[test]
fn certificates_that_are_over_or_nearly_so() {
    let Some(nearly) = Certificates::make("learner", 10) else { return };
    let (text, well) = nearly.examine();
    assert!(well && line(&text, "warn", "certificate").contains(" days"), "{text}");

    let expired = Certificates::make("learner", 0).unwrap();
    std::thread::sleep(std::time::Duration::from_millis(1100));
    let (text, well) = expired.examine();
    assert!(!well && line(&text, "FAIL", "certificate").contains("expired on "), "{text}");
}

#[test]
fn certificates_that_do_not_belong_together() {
    let Some(other) = Certificates::make("learner", 365) else { return };
    for (file, check, words) in
        [("ca.pem", "signature", "does not pass with ca.pem"), ("key.pem", "private key", "is not the key of cert.pem")]
    {
        let broken = Certificates::make("learner", 365).unwrap();
        std::fs::copy(other.path().join(file), broken.path().join(file)).unwrap();
        let (text, well) = broken.examine();
        assert!(!well && line(&text, "FAIL", check).contains(words), "{text}");
    }
    std::fs::write(other.path().join("cert.pem"), "no certificate").unwrap();
    std::fs::remove_file(other.path().join("key.pem")).unwrap();
    let (text, well) = other.examine();
    assert!(!well && text.contains("nothing of that kind in PEM") && text.contains("No such file"), "{text}");
}
