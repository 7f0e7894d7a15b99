//! A learner under test: its endpoints, its metrics, and what is in the folder of its run.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use quad_run::folder::{RunDir, RunEndpoints, ScoreLine};

use crate::process::{Process, built, stdout};
use crate::{eventually, http, wait_until};

pub struct Learner {
    pub process: Process,
    pub run_dir: PathBuf,
}

impl Learner {
    pub fn endpoint(&self) -> String {
        self.endpoints().zenoh.remove(0)
    }

    pub fn metrics(&self) -> String {
        self.endpoints().metrics
    }

    fn endpoints(&self) -> RunEndpoints {
        let dir = RunDir::at(&self.run_dir);
        eventually("the learner wrote endpoints.json", || dir.read_endpoints().ok())
    }

    /// Sum of the samples of `quad_learner_<name>` whose labels contain `label`; nothing if the
    /// learner does not answer now.
    pub fn metric(&self, name: &str, label: &str) -> Option<f64> {
        let endpoints = RunDir::at(&self.run_dir).read_endpoints().ok()?;
        let page = http::metrics(&endpoints.metrics)?;
        Some(http::sum(&page, &format!("quad_learner_{name}"), label))
    }

    pub fn wait_for_metric(&self, name: &str, label: &str, wanted: impl Fn(f64) -> bool) -> f64 {
        eventually(name, || self.metric(name, label).filter(|value| wanted(*value)))
    }

    /// Waits for so many new scores.
    pub fn wait_for_scores(&self, count: usize) {
        let before = self.scores().len();
        wait_until("there are new scores", || self.scores().len() >= before + count);
    }

    /// Waits for a successful end with every episode scored once, and its snapshot on the disk.
    pub fn assert_completes(&mut self) {
        self.process.assert_ends(0);
        verify(&self.run_dir, &[]);
    }

    pub fn scores(&self) -> Vec<ScoreLine> {
        RunDir::at(&self.run_dir).read_scores().expect("the lines are a learner's")
    }

    /// Fails unless snapshots, scores and the last checkpoint are those of another run, bit for
    /// bit.
    pub fn assert_same_as(&self, other: &Learner) {
        assert!(self.last_checkpoint() == other.last_checkpoint(), "the last checkpoints differ");
        verify(&self.run_dir, &[Path::new("--same-as"), &other.run_dir]);
    }

    fn last_checkpoint(&self) -> Vec<u8> {
        let files = fs::read_dir(self.run_dir.join("checkpoints")).unwrap();
        let last = files.map(|file| file.unwrap().path()).max().expect("there is a checkpoint");
        fs::read(last).unwrap()
    }

    pub fn snapshot(&self, step: u64) -> PathBuf {
        RunDir::at(&self.run_dir).snapshot_path(step)
    }
}

/// Runs `learner verify`, which must succeed.
pub fn verify(run_dir: &Path, flags: &[&Path]) {
    let mut verify = Command::new(built("learner"));
    stdout(&verify.arg("verify").arg(run_dir).args(flags).output().unwrap());
}
