//! `learner doctor` and `evaluator doctor`, on machines that are well and on ones that are not.

use std::net::TcpListener;
use std::process::{Command, Output};

use quad_protocol::keys;
use quad_tests::certificates::Certificates;
use quad_tests::made_up::name;
use quad_tests::process::{binary, preload};
use quad_tests::router::router;
use quad_tests::setting::IDLE;
use quad_tests::small_disk::SmallDisk;
use quad_tests::system::{Scratch, free_endpoint};
use serde_json::Value;

fn doctor(program: &str, arguments: &[&str]) -> Output {
    let mut command = Command::new(binary(program));
    command
        .arg("doctor")
        .args(arguments)
        .env_remove("RAYON_NUM_THREADS")
        .env_remove("QUAD_CERTIFICATES");
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

/// The line of a check that came out so, with those words in it or in the hint below.
fn assert_found(text: &str, verdict: &str, check: &str, words: &[&str]) {
    let start = format!("{verdict:4}  {check} ");
    let lines: Vec<_> = text.lines().collect();
    let line = lines.iter().position(|line| line.starts_with(&start));
    let line = line.unwrap_or_else(|| panic!("there is no line {start:?} in:\n{text}"));
    let hint = lines.get(line + 1).filter(|next| next.starts_with("      hint: "));
    let found = [lines[line], hint.unwrap_or(&"")].join("\n");
    assert!(words.iter().all(|word| found.contains(word)), "{words:?} are not in:\n{found}");
}

#[test]
fn a_machine_that_is_well() {
    let scratch = Scratch::new();
    let learner = scratch.learner("well", IDLE);
    let endpoint = learner.endpoint();
    let (text, well) = findings(&doctor("evaluator", &["--connect", &endpoint]));
    assert!(well, "{text}");
    assert_found(&text, "ok", "connection", &[&endpoint]);
    assert_found(&text, "ok", "run", &["well speaks version "]);
    assert_found(&text, "ok", "libmujoco", &["3.17.0, and Hopper moves in it"]);
    assert_found(&text, "ok", "precision", &[]);

    let folder = scratch.path().join("another");
    let (text, well) = findings(&doctor("learner", &["--run-dir", folder.to_str().unwrap()]));
    assert!(well, "{text}");
    // A busy disk is slow, which is worth a warning.
    assert!(
        text.lines().any(|line| line.contains("  run folder ") && line.contains("GiB free")),
        "{text}"
    );
    assert_found(&text, "ok", "HDF5", &["with compression"]);
    assert!(!folder.exists(), "the doctor makes no folder");

    let output = doctor("evaluator", &["--json", "--connect", &endpoint]);
    let list: Vec<Value> = serde_json::from_slice(&output.stdout).unwrap();
    assert!(list.len() > 4 && list.iter().all(|finding| finding["verdict"] != "fail"), "{list:?}");
}

#[test]
fn an_endpoint_that_does_not_answer() {
    let endpoint = free_endpoint();
    for program in ["learner", "evaluator"] {
        let (text, _) = findings(&doctor(program, &["--connect", &endpoint]));
        assert_found(&text, "FAIL", "connection", &["refused", "hint: that machine is there"]);
    }
    // It accepts, and never says a word.
    let mute = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("tcp/{}", mute.local_addr().unwrap());
    let (text, _) = findings(&doctor("evaluator", &["--connect", &endpoint]));
    assert_found(&text, "FAIL", "connection", &["no Zenoh session"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_learner_of_another_version() {
    let (endpoint, run) = (free_endpoint(), name("future"));
    let session = router(&endpoint).await;
    let answer = [&b"QUAD"[..], &999u16.to_le_bytes(), &[3, 0, 0, 0, 0]].concat();
    let queryable = session.declare_queryable(keys::jobs(&run)).callback(move |query| {
        zenoh::Wait::wait(query.reply(query.key_expr().clone(), answer.clone())).unwrap();
    });
    let _queryable = queryable.await.unwrap();
    let _token = session.liveliness().declare_token(keys::live_learner(&run, 1)).await.unwrap();
    let output =
        tokio::task::spawn_blocking(move || doctor("evaluator", &["--connect", &endpoint]))
            .await
            .unwrap();
    assert_found(&findings(&output).0, "FAIL", "run", &["protocol version 999", "hint: update"]);
}

#[test]
fn folders_that_cannot_be_written_to() {
    let (text, _) = findings(&doctor("learner", &["--run-dir", "/proc/runs/a"]));
    assert_found(&text, "FAIL", "run folder", &["/proc/runs/a"]);
    let scratch = Scratch::new();
    let Some(disk) = SmallDisk::mount(&scratch.path().join("disk"), 1) else { return };
    disk.fill();
    let (text, _) = findings(&doctor(
        "learner",
        &["--run-dir", scratch.path().join("disk/run").to_str().unwrap()],
    ));
    assert_found(&text, "FAIL", "run folder", &["No space left", "hint: make room"]);
}

#[test]
fn folders_where_files_have_no_locks() {
    let scratch = Scratch::new();
    let [launcher, preloaded] = <[String; 2]>::try_from(preload("no_locks")).unwrap();
    let mut command = Command::new(launcher);
    command
        .arg(preloaded)
        .arg(binary("learner"))
        .args(["doctor", "--run-dir"])
        .arg(scratch.path().join("run"));
    let (text, _) = findings(&command.output().unwrap());
    assert_found(&text, "warn", "locks", &["have no locks in", "hint: ", "scores.host"]);
    let (text, _) = findings(&doctor("learner", &["--run-dir", scratch.path().to_str().unwrap()]));
    assert_found(&text, "ok", "locks", &[]);
    let left = std::fs::read_dir(scratch.path()).unwrap().map(|entry| entry.unwrap().file_name());
    assert_eq!(left.collect::<Vec<_>>(), ["tiny.hdf5"], "the doctor leaves no file");
}

/// What may be wrong with certificates is tested where programs refuse them.
#[test]
fn certificates_that_are_good_and_that_are_not() {
    let Some(certificates) = Certificates::make() else { return };
    let examine = |name: &str| {
        findings(&doctor(
            "learner",
            &["--run-dir", "/tmp/run", "--certificates", &certificates.argument(name)],
        ))
        .0
    };
    assert_found(&examine("learner"), "ok", "certificate", &["127.0.0.1"]);
    assert_found(&examine("evaluator"), "FAIL", "certificate", &["quad-evaluator", "hint: "]);
}
