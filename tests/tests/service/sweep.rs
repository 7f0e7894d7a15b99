//! `learner sweep`: the runs of a study, and one pool of evaluators for all of them.

use std::fs;
use std::path::PathBuf;
use std::process::Command;

use quad_tests::process::{Process, binary};
use quad_tests::setting::{SHORT, Setting};
use quad_tests::system::Scratch;
use quad_tests::{PATIENCE, eventually};

/// Long enough for a signal in the middle of each run.
const SETTING: Setting = Setting { steps: 3000, eval_interval: 1000, ..SHORT };
const RUNS: [&str; 4] = ["none-seed0", "quad-seed0", "none-seed1", "quad-seed1"];

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
        command.arg("sweep").arg(self.scratch.path().join("study.toml")).arg("--runs").arg(self.scratch.path());
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
        let text = || fs::read_to_string(self.dir(run).join("metrics.jsonl")).ok().filter(|text| !text.is_empty());
        eventually(&format!("{run} trains"), PATIENCE, text);
    }

    /// What `--list` says of each run.
    fn states(&self) -> Vec<String> {
        let output = self.command(&["--list"]).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        text.lines().skip(1).zip(RUNS).map(|(line, run)| line.split_once(run).unwrap().1.trim().to_owned()).collect()
    }

    /// Every episode of every run has one score, and the runs are those of another study.
    fn assert_same_as(&self, other: &Study) {
        for run in RUNS {
            let mut verify = Command::new(binary("learner"));
            let output = verify.arg("verify").arg(self.dir(run)).arg("--same-as").arg(other.dir(run)).output().unwrap();
            assert!(output.status.success(), "{run}: {}", String::from_utf8_lossy(&output.stdout));
        }
    }
}

/// The learner that works on a run, among the processes that a sweep has started.
fn learner_of(sweep: &Process, run: &str) -> Option<u32> {
    let children = fs::read_to_string(format!("/proc/{0}/task/{0}/children", sweep.id())).ok()?;
    let is_its = |id: &u32| {
        let line = fs::read(format!("/proc/{id}/cmdline")).unwrap_or_default();
        String::from_utf8_lossy(&line).split('\0').any(|word| word.ends_with(run))
    };
    children.split_whitespace().filter_map(|id| id.parse().ok()).find(is_its)
}

#[test]
fn a_sweep_goes_on_after_an_interruption_and_a_failed_run_ends_no_other() {
    let (undisturbed, study) = (Study::new(), Study::new());
    let mut sweep = undisturbed.sweep(&["--jobs", "2"]);
    sweep.assert_succeeds(PATIENCE);
    assert!(sweep.out().contains("all 4 runs are complete"), "{}", sweep.out());
    assert!(sweep.log().contains("training takes about"), "{}", sweep.log());

    assert_eq!(study.states(), ["not begun"; 4]);
    let mut sweep = study.sweep(&["--jobs", "2"]);
    study.wait_for(RUNS[1]);
    sweep.signal("INT");
    assert_eq!(sweep.wait(PATIENCE).code(), Some(75), "{}", sweep.log());
    assert!(sweep.log().contains("the same command goes on"), "{}", sweep.log());
    assert_eq!(study.states()[3], "not begun");

    let mut sweep = study.sweep(&["--jobs", "2"]);
    let victim = RUNS[2];
    study.wait_for(victim);
    let learner = eventually("there is a learner", PATIENCE, || learner_of(&sweep, victim));
    assert!(Command::new("kill").args(["-KILL", &learner.to_string()]).status().unwrap().success());
    assert_eq!(sweep.wait(PATIENCE).code(), Some(1), "{}", sweep.log());
    let log = sweep.log();
    assert!(log.contains("1 of 4 runs have failed") && log.contains(&format!("{victim}/learner.log")), "{log}");
    let states = study.states();
    assert!(states[2].starts_with("failed after"), "{states:?}");
    assert_eq!([&*states[0], &states[1], &states[3]], ["complete"; 3]);

    study.sweep(&[]).assert_succeeds(PATIENCE);
    study.assert_same_as(&undisturbed);
}

#[test]
fn parts_of_a_study_are_done_by_number() {
    let study = Study::new();
    study.sweep(&["--shard", "2/2"]).assert_succeeds(PATIENCE);
    assert_eq!(study.states(), ["not begun", "complete", "not begun", "complete"]);
    study.sweep(&["--index", "2"]).assert_succeeds(PATIENCE);
    assert_eq!(study.states(), ["not begun", "complete", "complete", "complete"]);
    let mut sweep = study.sweep(&["--index", "0"]);
    study.wait_for(RUNS[0]);
    sweep.signal("TERM");
    assert_eq!(sweep.wait(PATIENCE).code(), Some(75), "{}", sweep.log());
    assert!(study.states()[0].ends_with("of 3000 steps"), "{:?}", study.states());
}

#[test]
fn a_run_of_other_settings_is_never_taken_for_one_of_the_study() {
    let study = Study::new();
    study.sweep(&["--index", "0"]).assert_succeeds(PATIENCE);
    study.scratch.preset("tiny", Setting { steps: 4000, ..SETTING });
    let mut sweep = study.sweep(&[]);
    assert_eq!(sweep.wait(PATIENCE).code(), Some(1));
    assert!(sweep.log().contains("has a run of other settings than the study's: steps"), "{}", sweep.log());
}
