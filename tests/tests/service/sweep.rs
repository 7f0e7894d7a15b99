//! `learner sweep`: the runs of a study, and one pool of evaluators for all of them.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use quad_tests::hanging_disk::launcher;
use quad_tests::learner::verify;
use quad_tests::process::{Process, binary, children, signal, stdout};
use quad_tests::setting::{SHORT, Setting};
use quad_tests::system::{Scratch, free_port};
use quad_tests::{PATIENCE, eventually};

/// Long enough for a run to be killed in the middle of it.
const SETTING: Setting = Setting { steps: 12_000, eval_interval: 4000, ..SHORT };
const RUNS: [&str; 4] = ["none-seed0", "quad-seed0", "none-seed1", "quad-seed1"];
/// Without evaluators no run is complete before its sweep is told to end, however fast it trains.
const UNSCORED: [&str; 2] = ["--evaluators", "0"];

struct Study {
    scratch: Scratch,
}

impl Study {
    fn new() -> Self {
        let scratch = Scratch::new();
        scratch.preset("tiny", SETTING);
        let study = format!(
            "about = 'a test'\n[run]\npreset = '{}'\ndataset = '{}'\n[axes]\nmethod = ['none', 'quad']\nseed = [0, 1]\n\
             [method.none]\nagent.guidance = 'none'\n[method.quad]\n",
            scratch.path().join("tiny.toml").display(),
            scratch.dataset().display()
        );
        fs::write(scratch.path().join("study.toml"), study).unwrap();
        Self { scratch }
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(binary("learner"));
        command.arg("sweep").arg(self.scratch.path().join("study.toml")).arg(self.scratch.path());
        // Those are for other networks than a sweep's own.
        command.args(arguments).env("QUAD_CERTIFICATES", "/nowhere");
        command
    }

    fn sweep(&self, arguments: &[&str]) -> Process {
        Process::start("sweep", self.scratch.path(), self.command(arguments))
    }

    fn dir(&self, run: &str) -> PathBuf {
        self.scratch.path().join("study").join(run)
    }

    /// Waits until a run has begun to train.
    fn wait_for(&self, run: &str) {
        let metrics = self.dir(run).join("metrics.jsonl");
        eventually(&format!("{run} trains"), PATIENCE, || {
            metrics.metadata().is_ok_and(|file| file.len() > 0).then_some(())
        });
    }

    /// The state of each run in `--list`.
    fn states(&self) -> Vec<String> {
        let list = stdout(&self.command(&["--list"]).output().unwrap());
        let states = list.lines().skip(1).zip(RUNS);
        states.map(|(line, run)| line.split_once(run).unwrap().1.trim().to_owned()).collect()
    }

    /// Every episode of every run has one score, and the runs are those of another study.
    fn assert_same_as(&self, other: &Study) {
        for run in RUNS {
            verify(&self.dir(run), &[Path::new("--same-as"), &other.dir(run)]);
        }
    }
}

/// The process that a sweep has started by a command line with a word that ends like this: a run's
/// learner, or an evaluator, whose word is `serve`.
fn child_of(sweep: &Process, end: &str) -> u32 {
    let line = |id: &u32| fs::read_to_string(format!("/proc/{id}/cmdline")).unwrap_or_default();
    eventually(&format!("{end} has started"), PATIENCE, || {
        let mut children = children(sweep.id()).into_iter();
        children.find(|id| line(id).split('\0').any(|word| word.ends_with(end)))
    })
}

#[test]
fn a_sweep_resumes_and_a_failed_run_ends_no_other() {
    let (undisturbed, study) = (Study::new(), Study::new());
    let mut sweep = undisturbed.sweep(&["--jobs", "2"]);
    sweep.assert_succeeds(PATIENCE);
    assert!(sweep.out().contains("4 runs complete"), "{}", sweep.out());
    sweep.assert_said("training takes about");

    assert_eq!(study.states(), ["not begun"; 4]);
    let mut sweep = study.sweep(&[["--jobs", "2"], UNSCORED].concat());
    study.wait_for(RUNS[1]);
    sweep.signal("INT");
    sweep.assert_ends(75, PATIENCE);
    assert_eq!(study.states()[3], "not begun");

    let mut sweep = study.sweep(&["--jobs", "2"]);
    let victim = RUNS[2];
    signal("KILL", child_of(&sweep, victim));
    sweep.assert_ends(1, PATIENCE);
    sweep.assert_said("1 of 4 runs failed");
    sweep.assert_said(&format!("{victim}: the learner ended by signal: 9 (SIGKILL)"));
    sweep.assert_said(&format!("{victim}/learner.log"));
    let states = study.states();
    assert!(states[2].starts_with("failed after"), "{states:?}");
    assert_eq!([&*states[0], &states[1], &states[3]], ["complete"; 3]);

    study.sweep(&[]).assert_succeeds(PATIENCE);
    study.assert_same_as(&undisturbed);
}

#[test]
fn shards_and_indices_train_parts_of_a_study() {
    let study = Study::new();
    study.sweep(&["--shard", "2/2"]).assert_succeeds(PATIENCE);
    assert_eq!(study.states(), ["not begun", "complete", "not begun", "complete"]);
    let address = format!("127.0.0.1:{}", free_port());
    study.sweep(&["--index", "2", "--http", &address]).assert_succeeds(PATIENCE);
    let endpoints = fs::read_to_string(study.dir(RUNS[2]).join("endpoints.json")).unwrap();
    assert!(endpoints.contains(&address), "{endpoints}");
    assert_eq!(study.states(), ["not begun", "complete", "complete", "complete"]);
    let sweep = study.sweep(&[["--index", "0"], UNSCORED].concat());
    study.wait_for(RUNS[0]);
    assert_stops(&study, sweep);
    let state = &study.states()[0];
    assert!(state.ends_with("of 12000 steps") || state == "trained, not all scored", "{state}");
}

#[test]
fn runs_with_other_settings_are_refused() {
    let study = Study::new();
    study.sweep(&["--index", "0"]).assert_succeeds(PATIENCE);
    study.scratch.preset("tiny", Setting { steps: 16_000, ..SETTING });
    let mut sweep = study.sweep(&[]);
    sweep.assert_ends(1, PATIENCE);
    sweep.assert_said("has a run of other settings than the study's: steps");
}

/// Its runs would train, and each wait ten minutes for an evaluator.
#[test]
fn a_sweep_whose_only_evaluator_is_killed_gets_another() {
    let study = Study::new();
    let mut sweep = study.sweep(&["--jobs", "1", "--evaluators", "1"]);
    study.wait_for(RUNS[0]);
    signal("KILL", child_of(&sweep, "serve"));
    sweep.assert_succeeds(PATIENCE);
    sweep.assert_said("an evaluator has ended (signal: 9");
}

/// As some init scripts and containers start programs.
#[test]
fn an_ignored_sigchld_and_zero_threads_change_nothing() {
    let study = Study::new();
    let command = study.command(&["--index", "0"]);
    // Not a shell's `trap`: some shells never ignore this signal.
    let mut env = Command::new("env");
    env.args(["--ignore-signal=CHLD", "RAYON_NUM_THREADS=0"]);
    env.arg(command.get_program()).args(command.get_args());
    Process::start("sweep", study.scratch.path(), env).assert_succeeds(PATIENCE);
    assert_eq!(study.states()[0], "complete");
}

#[test]
fn two_sweeps_of_one_study_do_not_disturb_each_other() {
    let study = Study::new();
    for (flags, run) in [(["--jobs", "1"], 0), (["--index", "2"], 2)] {
        let mut sweep = study.sweep(&[flags, UNSCORED].concat());
        study.wait_for(RUNS[run]);
        for others in [&[][..], &["--index", &run.to_string()]] {
            let second = study.command(others).output().unwrap();
            let said = String::from_utf8_lossy(&second.stderr);
            assert_eq!(second.status.code(), Some(75), "{flags:?}, {others:?}: {said}");
            let state = &study.states()[run];
            assert!(!state.starts_with("failed"), "{flags:?}, {others:?}: {state}");
        }
        sweep.terminate(PATIENCE);
    }
}

fn assert_stops(study: &Study, mut sweep: Process) {
    sweep.signal("TERM");
    sweep.assert_ends(75, PATIENCE);
    assert!(!study.states()[0].starts_with("failed"), "{:?}", study.states());
}

/// Slurm queues a task again by this exit code, so neither a slow disk nor a learner that has only
/// begun may change it.
#[test]
fn a_stopped_sweep_exits_with_75_whatever_hangs() {
    let study = Study::new();
    // At once: the learner does not yet listen to signals.
    let sweep = study.sweep(&[["--index", "0"], UNSCORED].concat());
    child_of(&sweep, RUNS[0]);
    assert_stops(&study, sweep);

    // A learner that is frozen, as by a disk that hangs.
    let sweep = study.sweep(&[["--index", "0"], UNSCORED].concat());
    let learner = child_of(&sweep, RUNS[0]);
    study.wait_for(RUNS[0]);
    signal("STOP", learner);
    assert_stops(&study, sweep);

    // A disk that hangs when the sweep marks one of three runs as failed.
    let mut through = Command::new("env");
    through.args(&launcher("fsync", &study.dir(RUNS[1]).join("failed"))[1..]);
    through
        .arg(binary("learner"))
        .args(study.command(&[["--jobs", "3"], UNSCORED].concat()).get_args());
    let sweep = Process::start("sweep", study.scratch.path(), through);
    study.wait_for(RUNS[1]);
    signal("KILL", child_of(&sweep, RUNS[1]));
    study.wait_for(RUNS[2]);
    assert_stops(&study, sweep);
    eventually("the sweep has told its learner to end", PATIENCE, || {
        let log = fs::read_to_string(study.dir(RUNS[2]).join("learner.log")).unwrap();
        log.contains("received SIGTERM").then_some(())
    });
}
