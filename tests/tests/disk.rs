//! A disk that is full or hangs delays what is kept, and ends neither the training nor what was kept before.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::sleep;
use std::time::{Duration, Instant};

use quad_tests::router::router;
use quad_tests::system::{Learner, Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http};

/// Seconds of training, also where a step takes 50 µs: things happen in the middle of it.
const SETTING: Setting =
    Setting { steps: 40_000, eval_interval: 5_000, episodes: 4, candidates: 2, hidden: 32, seed: 2 };
const LISTEN: [&str; 4] = ["--listen", "tcp/127.0.0.1:0", "--checkpoint-seconds", "0"];

/// A disk of a few megabytes, unmounted when dropped.
struct SmallDisk {
    path: PathBuf,
}

impl SmallDisk {
    fn mount(path: PathBuf) -> Option<Self> {
        fs::create_dir_all(&path).unwrap();
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", "size=6m", "tmpfs"]).arg(&path).output();
        let mounted = mounted.is_ok_and(|output| output.status.success());
        if !mounted {
            eprintln!("skipped: mounting a tmpfs needs the rights of root");
        }
        mounted.then_some(Self { path })
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        Command::new("umount").arg("--lazy").arg(&self.path).status().ok();
    }
}

fn metric(learner: &Learner, name: &str) -> Option<f64> {
    Some(http::sum(&http::metrics(&learner.metrics())?, &format!("quad_learner_{name}"), ""))
}

fn wait_for_metric(learner: &Learner, name: &str, wanted: impl Fn(f64) -> bool) -> f64 {
    eventually(name, PATIENCE, || metric(learner, name).filter(|value| wanted(*value)))
}

/// As many bytes as the disk has left.
fn fill(path: &Path) {
    let mut file = fs::File::create(path).unwrap();
    let block = vec![0; 4096];
    while std::io::Write::write_all(&mut file, &block).is_ok() {}
}

#[test]
fn a_full_disk_delays_scores_and_checkpoints_until_there_is_room() {
    let scratch = Scratch::new();
    let Some(disk) = SmallDisk::mount(scratch.path().join("run")) else { return };
    // Long enough for the disk to be full in the middle of it.
    let setting = Setting { hidden: 64, ..SETTING };
    let mut learner = scratch.learner_with("run", setting, &LISTEN);
    let _evaluator = scratch.evaluator("one", &learner.endpoint());
    eventually("there are scores", PATIENCE, || (!learner.scores().is_empty()).then_some(()));
    fill(&disk.path.join("filler"));
    wait_for_metric(&learner, "disk_trouble", |trouble| trouble > 0.0);
    let (steps, scores) = (metric(&learner, "gradient_steps_total").unwrap(), learner.scores().len());
    learner.process.wait_for_log("No space left on device", PATIENCE);
    let (status, health) = http::get(&learner.metrics(), "/healthz").expect("the learner answers");
    assert!(status == 503 && health.contains("keeper: the run cannot be saved"), "{status} {health}");
    // By now, snapshots have been due as well.
    let later = steps + 2.0 * setting.eval_interval as f64;
    wait_for_metric(&learner, "gradient_steps_total", |now| now == setting.steps as f64 || now > later);
    assert!(learner.scores().len() <= scores + 8, "a score counts as kept though there was no room for it");

    fs::remove_file(disk.path.join("filler")).unwrap();
    learner.process.wait_for_log("the run can be saved again", PATIENCE);
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&setting);
}

#[test]
fn scores_wait_for_a_disk_that_is_full_and_that_is_told() {
    let scratch = Scratch::new();
    let Some(disk) = SmallDisk::mount(scratch.path().join("run")) else { return };
    let setting = Setting { steps: 500, eval_interval: 250, ..SETTING };
    let mut learner = scratch.learner_with("run", setting, &LISTEN);
    learner.process.wait_for_log("waiting for the scores", PATIENCE);
    fill(&disk.path.join("filler"));
    let evaluator = scratch.evaluator("one", &learner.endpoint());
    let of_scores = || Some(http::sum(&http::metrics(&learner.metrics())?, "quad_learner_disk_trouble", "scores"));
    eventually("the metric tells of it", PATIENCE, || (of_scores()? == 1.0).then_some(()));
    learner.process.wait_for_log("scores cannot be saved", PATIENCE);
    let (status, health) = http::get(&learner.metrics(), "/healthz").expect("the learner answers");
    assert!(status == 503 && health.contains("scribe: scores cannot be saved"), "{status} {health}");
    evaluator.process.wait_for_log("No space left on device", PATIENCE);
    assert!(learner.scores().is_empty());

    fs::remove_file(disk.path.join("filler")).unwrap();
    learner.process.wait_for_log("scores can be saved again", PATIENCE);
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&setting);
    let measured = http::sum(&http::metrics(&evaluator.metrics()).unwrap(), "quad_evaluator_episodes_total", "");
    assert_eq!(measured, 8.0, "nothing is measured twice");
}

#[test]
fn what_only_scripts_read_is_written_later_if_it_must_be() {
    let scratch = Scratch::new();
    // Nothing can be written to a file that is a folder.
    let obstacle = scratch.path().join("run/endpoints.json.partial");
    fs::create_dir_all(&obstacle).unwrap();
    let setting = Setting { steps: 500, eval_interval: 250, ..SETTING };
    let mut learner = scratch.learner_with("run", setting, &LISTEN);
    learner.process.wait_for_log("cannot write", PATIENCE);
    learner.process.wait_for_log("training is done", PATIENCE);
    fs::remove_dir(&obstacle).unwrap();
    let _evaluator = scratch.evaluator("one", &learner.endpoint());
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&setting);
}

/// Makes the disk of a learner that has ended hang at its next snapshot; gives the step of that.
fn hang(learner: &Learner) -> u64 {
    let kept = fs::read_dir(learner.run_dir.join("snapshots")).unwrap().count() as u64;
    let next = (kept + 1) * SETTING.eval_interval;
    assert!(next < SETTING.steps, "the training was over too soon");
    make_pipe(&pipe(learner, next));
    next
}

/// Who opens a pipe to write into it waits until somebody reads from it.
fn make_pipe(path: &Path) {
    assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
}

fn pipe(learner: &Learner, step: u64) -> PathBuf {
    learner.snapshot(step).with_extension("safetensors.partial")
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_that_fails_while_the_disk_hangs_says_why_and_ends() {
    let (scratch, other) = (Scratch::new(), Scratch::new());
    let mut learner = scratch.learner_with("run", SETTING, &LISTEN);
    let evaluator = scratch.evaluator("one", &learner.endpoint());
    eventually("there are scores", PATIENCE, || (!learner.scores().is_empty()).then_some(()));
    learner.process.terminate(PATIENCE);
    drop(evaluator);
    let next = hang(&learner);
    // With scores, there is a report to write.
    make_pipe(&learner.run_dir.join("report.json.partial"));

    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let _router = router(&endpoint).await;
    let endless = Setting { steps: 100_000_000, ..SETTING };
    let first = other.learner_with("run", endless, &["--connect", &endpoint]);
    first.process.wait_for_log("its metrics at", PATIENCE);
    let mut learner = scratch.learner_with("run", SETTING, &["--connect", &endpoint, "--checkpoint-seconds", "0"]);
    learner.process.wait_for_log("there is another learner of run run", PATIENCE);
    let begin = Instant::now();
    let status = learner.process.wait(PATIENCE);
    let took = begin.elapsed();
    assert!(!learner.snapshot(next).exists(), "the disk did not hang");
    assert_eq!(status.code(), Some(1), "{}", learner.process.log());
    assert!((10..25).contains(&took.as_secs()), "it took {took:?} to give the disk up");
    assert!(learner.process.log().contains("the disk did not take"), "{}", learner.process.log());
}

#[test]
fn a_disk_that_hangs_holds_up_neither_training_nor_the_end() {
    let scratch = Scratch::new();
    let mut learner = scratch.learner_with("run", SETTING, &LISTEN);
    learner.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
    learner.process.terminate(PATIENCE);

    let next = hang(&learner);
    // One signal ends it within 10 s, two end it at once.
    for (signals, least, most) in [(1, 5, 10), (2, 0, 4)] {
        let mut learner = scratch.learner_with("run", SETTING, &LISTEN);
        learner.process.wait_for_log("goes on after step", PATIENCE);
        wait_for_metric(&learner, "gradient_steps_total", |steps| steps == SETTING.steps as f64);
        sleep(Duration::from_millis(200));
        assert!(!learner.snapshot(next).exists(), "the disk did not hang");
        let begin = Instant::now();
        for _ in 0..signals {
            learner.process.signal("TERM");
            learner.process.wait_for_log("received SIGTERM", PATIENCE);
            // Sooner, the next one would count as the same.
            sleep(Duration::from_millis(600));
        }
        let status = learner.process.wait(PATIENCE);
        let seconds = begin.elapsed().as_secs();
        assert!((least..most).contains(&seconds), "it took {seconds} s to leave after {signals} signals");
        assert_eq!(status.code(), Some(130), "{status}");
    }

    fs::remove_file(pipe(&learner, next)).unwrap();
    let mut learner = scratch.learner_with("run", SETTING, &LISTEN);
    let _evaluator = scratch.evaluator("one", &learner.endpoint());
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&SETTING);
}
