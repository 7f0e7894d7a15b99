//! `learner train --from RUN`: the run whose last checkpoint another run begins with.

use std::path::Path;

use anyhow::anyhow;
use quad_protocol::Hash;
use quad_run::config::{ConfigError, Experiment, Preset};
use quad_run::folder::{Checkpoint, RunDir};
use quad_runtime::{Hint, hinted};
use toml::Table;

/// The end of a complete run.
pub(super) struct EarlierRun {
    pub checkpoint: Checkpoint,
    /// Hash of the checkpoint.
    pub hash: String,
    /// Episodes that it has not learned from.
    pub held_out: Vec<usize>,
    experiment: Experiment,
    dataset_sha256: Option<String>,
}

impl EarlierRun {
    /// Reads the run, and makes a preset of its settings.
    ///
    /// # Errors
    /// The run is not complete, its checkpoints were deleted, or its algorithm cannot practice.
    pub fn read(run: &Path) -> anyhow::Result<(Self, Preset)> {
        let (dir, config) = RunDir::open(run)?;
        if config.experiment.online.is_some() {
            let error = anyhow!("the run in {} has practiced already", run.display());
            return Err(hinted(error, "--from takes a run of the dataset alone"));
        }
        let steps = config.experiment.steps;
        let Some(checkpoint) = dir.newest_checkpoint()? else {
            let error = anyhow!("the run in {} has no checkpoint", run.display());
            let hint = "--from begins with a run's last one: put checkpoints/ back if it was \
                        deleted, or let the run end";
            return Err(hinted(error, hint));
        };
        if checkpoint.step != steps {
            let error =
                anyhow!("the run in {} has not reached its last step, {steps}", run.display());
            let hint = "let it end first: `learner train` with its settings continues it";
            return Err(hinted(error, hint));
        }
        let mut own = Table::try_from(&config.experiment)?;
        let hash = Hash::of(&checkpoint.state).to_string();
        own.insert("from".to_owned(), hash.clone().into());
        // A share of 0 is not in the table, but the task may have another.
        own.insert("hold_out".to_owned(), config.experiment.hold_out.into());
        let preset = Preset::of_run(&config, own).hint_of(ConfigError::hint)?;
        let (experiment, dataset_sha256) = (config.experiment, config.dataset.sha256);
        let held_out = config.dataset.held_out;
        Ok((Self { checkpoint, hash, held_out, experiment, dataset_sha256 }, preset))
    }

    /// Checks that there is practice, that the dataset is the run's, and that the checkpoint's
    /// numbers still mean the same.
    pub fn check(&self, here: &Experiment, sha256: &str) -> anyhow::Result<()> {
        if here.online.is_none() {
            let error = anyhow!("without practice there is nothing to go on with");
            return Err(hinted(error, "--online-steps N, above 0, says how much of it"));
        }
        let there = &self.experiment;
        let known = self.dataset_sha256.as_deref().unwrap_or(sha256);
        let kept = [
            ("dataset", known == sha256),
            ("steps", there.steps == here.steps),
            ("reward", there.reward == here.reward),
            ("normalize", there.normalize == here.normalize),
            ("hold_out", there.hold_out == here.hold_out),
        ];
        let Some((key, _)) = kept.iter().find(|(_, is_kept)| !is_kept) else { return Ok(()) };
        let error = anyhow!("the run of --from has learned with another value of {key}");
        Err(hinted(error, "leave it as it was there: what has been learned depends on it"))
    }
}
