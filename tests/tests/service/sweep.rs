//! `learner sweep`: the runs of a study, and one pool of evaluators for all of them.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use quad_tests::disk::hanging;
use quad_tests::learner::verify;
use quad_tests::process::{Process, built, children, signal, stdout};
use quad_tests::setting::{SHORT, Setting};
use quad_tests::system::Scratch;
use quad_tests::{eventually, wait_until};

const SETTING: Setting = Setting { steps: 12_000, eval_interval: 4000, ..SHORT };
const RUNS: [&str; 4] = ["none-seed0", "quad-seed0", "none-seed1", "quad-seed1"];
/// Without evaluators no run is complete before its sweep is told to end, however fast it trains.
const UNSCORED: &str = "--evaluators 0";

struct Study {
    scratch: Scratch,
}

impl Study {
    fn new() -> Self {
        let scratch = Scratch::new();
        let preset = scratch.preset("tiny", SETTING);
        let study = format!(
            "about = 'a test'\n[run]\npreset = {preset:?}\ndataset = {:?}\n[axes]\nmethod = ['none', 'quad']\n\
             seed = [0, 1]\n[method.none]\nagent.guidance = 'none'\n[method.quad]\n",
            scratch.dataset()
        );
        fs::write(scratch.path().join("study.toml"), study).unwrap();
        Self { scratch }
    }

    /// The command behind a prefix such as `env`.
    fn command(&self, launcher: &[String], flags: &str) -> Command {
        // Those are for other networks than a sweep's own.
        let env = ["env".to_owned(), "QUAD_CERTIFICATES=/nowhere".to_owned()];
        let words = [&env, launcher].concat();
        let mut command = Command::new(&words[0]);
        command.args(&words[1..]).arg(built("learner")).arg("sweep");
        command.arg(self.scratch.path().join("study.toml")).arg(self.scratch.path());
        command.args(flags.split_whitespace());
        command
    }

    fn sweep(&self, flags: &str) -> Process {
        self.sweep_through(&[], flags)
    }

    fn sweep_through(&self, launcher: &[String], flags: &str) -> Process {
        Process::start("sweep", self.scratch.path(), self.command(launcher, flags))
    }

    fn dir(&self, run: &str) -> PathBuf {
        self.scratch.path().join("study").join(run)
    }

    /// Waits until a run has begun to train.
    fn wait_for(&self, run: &str) {
        let metrics = self.dir(run).join("metrics.jsonl");
        wait_until(run, || metrics.metadata().is_ok_and(|file| file.len() > 0));
    }

    /// The state of each run in `--list`.
    fn states(&self) -> Vec<String> {
        let list = stdout(&self.command(&[], "--list").output().unwrap());
        let states = list.lines().skip(1).zip(RUNS);
        states.map(|(line, run)| line.split_once(run).unwrap().1.trim().to_owned()).collect()
    }

    fn assert_stops(&self, mut sweep: Process) {
        sweep.signal("TERM");
        sweep.assert_ends(75);
        assert!(!self.states()[0].starts_with("failed"), "{:?}", self.states());
    }
}

/// The learner that a sweep has started for a run.
fn child(sweep: &Process, run: &str) -> u32 {
    let line = |id: &u32| fs::read_to_string(format!("/proc/{id}/cmdline")).unwrap_or_default();
    eventually(&format!("{run} has started"), || {
        let mut children = children(sweep.id()).into_iter();
        children.find(|id| line(id).split('\0').any(|word| word.ends_with(run)))
    })
}

#[test]
fn a_sweep_resumes_and_a_failed_run_ends_no_other() {
    let (undisturbed, study) = (Study::new(), Study::new());
    let mut sweep = undisturbed.sweep("--jobs 2");
    sweep.assert_ends(0);
    sweep.assert_said("4 runs complete");
    sweep.assert_said("training takes about");

    assert_eq!(study.states(), ["not begun"; 4]);
    let mut sweep = study.sweep(&format!("--jobs 2 {UNSCORED}"));
    study.wait_for(RUNS[1]);
    sweep.signal("INT");
    sweep.assert_ends(75);
    assert_eq!(study.states()[3], "not begun");

    // It never comes to an end by itself.
    let victim = RUNS[2];
    let launcher = hanging(&study.dir(victim).join("snapshots"));
    let mut sweep = study.sweep_through(&launcher, "--jobs 2");
    signal("KILL", child(&sweep, victim));
    sweep.assert_ends(1);
    sweep.assert_said("1 of 4 runs failed");
    sweep.assert_said(&format!("{victim}: the learner ended by signal: 9 (SIGKILL)"));
    sweep.assert_said(&format!("{victim}/learner.log"));
    let states = study.states();
    assert!(states[2].starts_with("failed after"), "{states:?}");
    assert_eq!([&*states[0], &states[1], &states[3]], ["complete"; 3]);

    // As some init scripts and containers start programs; not a shell's `trap`, by which some never
    // ignore this signal.
    let launcher = ["env", "--ignore-signal=CHLD", "RAYON_NUM_THREADS=0"].map(str::to_owned);
    study.sweep_through(&launcher, "").assert_ends(0);
    for run in RUNS {
        verify(&study.dir(run), &[Path::new("--same-as"), &undisturbed.dir(run)]);
    }
}

#[test]
fn two_sweeps_of_one_study_do_not_disturb_each_other() {
    let study = Study::new();
    for (flags, run) in [("--jobs 1", 0), ("--index 2", 2)] {
        let mut sweep = study.sweep(&format!("{flags} {UNSCORED}"));
        study.wait_for(RUNS[run]);
        for second in ["", &format!("--index {run}")] {
            let output = study.command(&[], second).output().unwrap();
            assert_eq!(output.status.code(), Some(75), "{flags:?}, {second:?}: {output:?}");
            let state = &study.states()[run];
            assert!(!state.starts_with("failed"), "{flags:?}, {second:?}: {state}");
        }
        sweep.signal("TERM");
        sweep.wait();
    }
}

/// Slurm queues a task again by this exit code.
#[test]
fn a_stopped_sweep_exits_with_75_whatever_hangs() {
    let study = Study::new();
    // A learner that is frozen, as by a disk that hangs.
    let sweep = study.sweep(&format!("--index 0 {UNSCORED}"));
    study.wait_for(RUNS[0]);
    signal("STOP", child(&sweep, RUNS[0]));
    study.assert_stops(sweep);

    // A disk that hangs when the sweep marks one of three runs as failed.
    let launcher = hanging(&study.dir(RUNS[1]).join("failed"));
    let sweep = study.sweep_through(&launcher, &format!("--jobs 3 {UNSCORED}"));
    study.wait_for(RUNS[1]);
    signal("KILL", child(&sweep, RUNS[1]));
    study.wait_for(RUNS[2]);
    study.assert_stops(sweep);
    wait_until("the sweep has told its learner to end", || {
        let log = fs::read_to_string(study.dir(RUNS[2]).join("learner.log")).unwrap();
        log.contains("received SIGTERM")
    });
}
