//! A learner under test: its endpoints, its metrics, and what is in the folder of its run.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use quad_run::folder::{RunDir, RunEndpoints, ScoreLine};

use crate::process::{Process, binary, stdout};
use crate::{PATIENCE, eventually, http};

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
        eventually("the learner wrote endpoints.json", PATIENCE, || dir.read_endpoints().ok())
    }

    /// Sum of the samples of `quad_learner_<name>` whose labels contain `label`.
    pub fn metric(&self, name: &str, label: &str) -> Option<f64> {
        Some(http::sum(&http::metrics(&self.metrics())?, &format!("quad_learner_{name}"), label))
    }

    pub fn wait_for_metric(&self, name: &str, label: &str, wanted: impl Fn(f64) -> bool) -> f64 {
        eventually(name, PATIENCE, || self.metric(name, label).filter(|value| wanted(*value)))
    }

    pub fn wait_for_scores(&self, count: usize) {
        eventually("there are scores", PATIENCE, || (self.scores().len() > count).then_some(()));
    }

    /// Waits for a successful end with every episode scored once.
    pub fn assert_completes(&mut self, patience: Duration) {
        self.process.assert_succeeds(patience);
        self.assert_complete();
    }

    pub fn scores(&self) -> Vec<ScoreLine> {
        RunDir::at(&self.run_dir).read_scores().expect("the lines are a learner's")
    }

    /// Reads all scores, and asserts that no episode is scored twice.
    pub fn assert_scores_are_distinct(&self) -> Vec<ScoreLine> {
        let scores = self.scores();
        let keys: BTreeSet<_> = scores.iter().map(|score| (score.step, score.seed)).collect();
        assert_eq!(keys.len(), scores.len(), "a (step, seed) has two scores");
        scores
    }

    /// Fails unless `learner verify` finds every episode of every evaluation scored once, with the
    /// snapshot on disk.
    pub fn assert_complete(&self) {
        verify(&self.run_dir, &[]);
    }

    /// Fails unless snapshots, scores and the last checkpoint are those of another run, bit for
    /// bit; gives what `learner verify` says.
    pub fn assert_same_as(&self, other: &Learner) -> String {
        let last = |learner: &Learner| {
            learner.files("checkpoints").pop_last().expect("there is a checkpoint")
        };
        assert!(last(self) == last(other), "the last checkpoints differ");
        verify(&self.run_dir, &[Path::new("--same-as"), &other.run_dir])
    }

    /// The whole files of a folder in the run's, name by name; none if it is not there.
    pub fn files(&self, folder: &str) -> BTreeMap<String, Vec<u8>> {
        let entries = fs::read_dir(self.run_dir.join(folder)).into_iter().flatten().flatten();
        let files = entries
            .filter_map(|entry| Some((name_of(&entry.path())?, fs::read(entry.path()).ok()?)));
        files.filter(|(name, _)| !name.ends_with(".partial")).collect()
    }

    pub fn snapshot(&self, step: u64) -> PathBuf {
        RunDir::at(&self.run_dir).snapshot_path(step)
    }
}

/// Runs `learner verify`, which must succeed, and returns its output.
pub fn verify(run_dir: &Path, flags: &[&Path]) -> String {
    let mut verify = Command::new(binary("learner"));
    stdout(&verify.arg("verify").arg(run_dir).args(flags).output().unwrap())
}

fn name_of(path: &Path) -> Option<String> {
    Some(path.file_name()?.to_str()?.to_owned())
}
