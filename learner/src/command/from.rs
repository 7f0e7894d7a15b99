//! `learner train --from RUN`: the run whose last checkpoint another run begins with.

use std::path::Path;

use anyhow::{Context, anyhow};
use quad_protocol::Hash;
use quad_run::config::{ConfigError, Preset};
use quad_run::folder::{Checkpoint, RunDir};
use quad_runtime::{Hint, hinted};
use toml::Table;

/// The end of a complete run.
pub(super) struct From {
    checkpoint: Checkpoint,
    dataset_sha256: Option<String>,
}

impl From {
    /// Reads the run, and makes a preset of its settings.
    ///
    /// # Errors
    /// The run is not complete, or its algorithm cannot practice.
    pub fn read(run: &Path) -> anyhow::Result<(Self, Preset)> {
        let (dir, config) = RunDir::open(run)?;
        if config.experiment.online.is_some() {
            let error = anyhow!("the run in {} has practiced already", run.display());
            return Err(hinted(error, "--from takes a run of the dataset alone"));
        }
        let steps = config.experiment.steps;
        let checkpoint = dir.newest_checkpoint()?.filter(|checkpoint| checkpoint.step == steps);
        let checkpoint = checkpoint
            .with_context(|| {
                format!("the run in {} has not reached its last step, {steps}", run.display())
            })
            .hint("let it end first: `learner train` with its settings continues it")?;
        let mut own = Table::try_from(&config.experiment)?;
        own.insert("from".to_owned(), Hash::of(&checkpoint.state).to_string().into());
        let preset = Preset::of_run(&config, own).hint_of(ConfigError::hint)?;
        Ok((Self { checkpoint, dataset_sha256: config.dataset.sha256 }, preset))
    }

    /// Checks that the dataset is the run's.
    pub fn check_dataset(&self, sha256: &str) -> anyhow::Result<()> {
        let is_same = self.dataset_sha256.as_ref().is_none_or(|known| known == sha256);
        is_same.then_some(()).context("the dataset is not the one that the run has learned from")
    }

    /// The checkpoint to begin with.
    pub fn into_checkpoint(self) -> Checkpoint {
        self.checkpoint
    }
}
