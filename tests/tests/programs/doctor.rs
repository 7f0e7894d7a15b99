//! `learner doctor` and `evaluator doctor` with a learner, a router or a disk of their own. The other
//! checks are in doctor.trycmd.

use std::sync::Mutex;

use quad_protocol::keys;
use quad_runtime::open_router;
use quad_tests::disk::SmallDisk;
use quad_tests::made_up::name;
use quad_tests::process::command;
use quad_tests::setting::IDLE;
use quad_tests::system::Scratch;

/// The findings as text. The exit code says whether one of them fails.
fn doctor(line: &str) -> String {
    let mut doctor = command(line);
    doctor.envs(["D4RL_DATASET_DIR", "HOME"].map(|folder| (folder, std::env::temp_dir())));
    let output = doctor.output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let failed = text.lines().any(|line| line.starts_with("FAIL  "));
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(failed.into()), "{text}\n{said}");
    assert_eq!(failed, said.contains("checks failed"), "{said}");
    text
}

/// The line of a check that came out so, with those words in it or in the hint below.
fn assert_finds(text: &str, verdict: &str, check: &str, words: &[&str]) {
    let start = format!("{verdict:4}  {check} ");
    let (_, rest) = text.split_once(&start).unwrap_or_else(|| panic!("no {start:?} in:\n{text}"));
    let lines = Vec::from_iter(rest.lines().take(2)).join("\n");
    assert!(words.iter().all(|word| lines.contains(word)), "{words:?} are not in:\n{lines}");
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
        assert_finds(&text, "ok", check, &[words]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn learners_that_hang_or_have_another_version_fail() {
    let newer = [&b"QUAD"[..], &999u16.to_le_bytes(), &[3, 0, 0, 0, 0]].concat();
    let version = ["protocol version 999", "hint: update"];
    let hangs = ["hanging: its learner has not answered within 5s"];
    for (run, answer, words) in [("future", Some(newer), &version[..]), ("hanging", None, &hangs)] {
        let (session, endpoint) = open_router().await.unwrap();
        // A question that is dropped would have its end as the answer.
        let kept = Mutex::new(Vec::new());
        let callback = move |query: zenoh::query::Query| match &answer {
            Some(answer) => {
                let reply = query.reply(query.key_expr().clone(), answer.clone());
                zenoh::Wait::wait(reply).unwrap();
            }
            None => kept.lock().unwrap().push(query),
        };
        let run = name(run);
        let queryable = session.declare_queryable(keys::jobs(&run)).callback(callback);
        let _queryable = queryable.await.unwrap();
        let token = session.liveliness().declare_token(keys::live_learner(&run, 1));
        let _token = token.await.unwrap();
        let text = doctor(&format!("evaluator doctor --connect {endpoint}"));
        assert_finds(&text, "FAIL", "run", words);
    }
}

#[test]
fn a_full_disk_fails() {
    let scratch = Scratch::new();
    let folder = scratch.path().join("disk");
    let Some(disk) = SmallDisk::mount(&folder, 50) else { return };
    let doctor = || doctor(&format!("learner doctor --run-dir {}/run", folder.display()));
    // Too little for a checkpoint.
    assert_finds(&doctor(), "FAIL", "run folder", &["GiB free", "hint: make room"]);
    disk.fill();
    assert_finds(&doctor(), "FAIL", "run folder", &["No space left", "hint: make room"]);
}
