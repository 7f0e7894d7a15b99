//! `learner doctor` and `evaluator doctor` with a learner, a router or a disk of their own. The other
//! checks are in doctor.trycmd.

use std::sync::Mutex;

use quad_protocol::keys;
use quad_tests::made_up::name;
use quad_tests::process::command;
use quad_tests::router::router;
use quad_tests::setting::IDLE;
use quad_tests::small_disk::SmallDisk;
use quad_tests::system::{Scratch, free_endpoint};
use serde_json::Value;

/// The findings as text. The exit code says whether one of them fails.
fn doctor(line: &str) -> String {
    let mut doctor = command(line);
    doctor.envs(["D4RL_DATASET_DIR", "HOME"].map(|folder| (folder, std::env::temp_dir())));
    let output = doctor.output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let failed = text.lines().any(|line| line.starts_with("FAIL  "));
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(failed.into()), "{text}\n{said}");
    assert!(!failed || said.contains("checks failed"), "{said}");
    text
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
fn a_healthy_machine_passes_all_checks() {
    let scratch = Scratch::new();
    let learner = scratch.learner("well", IDLE);
    let endpoint = learner.endpoint();
    let text = doctor(&format!("evaluator doctor --connect {endpoint}"));
    for (check, words) in [
        ("connection", &*endpoint),
        ("run", "well speaks version "),
        ("libmujoco", "3.17.0 simulates Hopper"),
        ("precision", ""),
    ] {
        assert_found(&text, "ok", check, &[words]);
    }
    assert!(!text.contains("FAIL"), "{text}");

    let folder = scratch.path().join("another");
    let text = doctor(&format!("learner doctor --run-dir {}", folder.display()));
    // A busy disk is slow, which is worth a warning.
    let has_room = |line: &str| line.contains("  run folder ") && line.contains("GiB free");
    assert!(text.lines().any(has_room) && !text.contains("FAIL"), "{text}");
    assert_found(&text, "ok", "HDF5", &["with compression"]);
    assert!(!folder.exists(), "the doctor makes no folder");

    let list = doctor(&format!("evaluator doctor --json --connect {endpoint}"));
    let list: Vec<Value> = serde_json::from_str(&list).unwrap();
    assert!(list.len() > 4 && list.iter().all(|finding| finding["verdict"] != "fail"), "{list:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_learner_of_another_version_fails() {
    let (endpoint, run) = (free_endpoint(), name("future"));
    let session = router(&endpoint).await;
    let answer = [&b"QUAD"[..], &999u16.to_le_bytes(), &[3, 0, 0, 0, 0]].concat();
    let queryable = session.declare_queryable(keys::jobs(&run)).callback(move |query| {
        zenoh::Wait::wait(query.reply(query.key_expr().clone(), answer.clone())).unwrap();
    });
    let _queryable = queryable.await.unwrap();
    let _token = session.liveliness().declare_token(keys::live_learner(&run, 1)).await.unwrap();
    let line = format!("evaluator doctor --connect {endpoint}");
    let text = tokio::task::spawn_blocking(move || doctor(&line)).await.unwrap();
    assert_found(&text, "FAIL", "run", &["protocol version 999", "hint: update"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_learner_that_hangs_fails() {
    let (endpoint, run) = (free_endpoint(), name("hanging"));
    let session = router(&endpoint).await;
    // A question that is dropped would have its end as the answer.
    let kept = Mutex::new(Vec::new());
    let queryable = session.declare_queryable(keys::jobs(&run));
    let queryable = queryable.callback(move |query| kept.lock().unwrap().push(query));
    let _queryable = queryable.await.unwrap();
    let _token = session.liveliness().declare_token(keys::live_learner(&run, 1)).await.unwrap();
    let line = format!("evaluator doctor --connect {endpoint}");
    let text = tokio::task::spawn_blocking(move || doctor(&line)).await.unwrap();
    assert_found(&text, "FAIL", "run", &["hanging: its learner has not answered within 5s"]);
}

#[test]
fn a_full_disk_fails() {
    let scratch = Scratch::new();
    let folder = scratch.path().join("disk");
    let Some(disk) = SmallDisk::mount(&folder, 50) else { return };
    let doctor = || doctor(&format!("learner doctor --run-dir {}/run", folder.display()));
    // Too little for a checkpoint.
    assert_found(&doctor(), "FAIL", "run folder", &["GiB free", "hint: make room"]);
    disk.fill();
    assert_found(&doctor(), "FAIL", "run folder", &["No space left", "hint: make room"]);
}
