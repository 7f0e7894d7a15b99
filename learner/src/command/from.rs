//! `learner train --from RUN`: the run whose last checkpoint another run begins with.

use std::path::{Path, PathBuf, absolute};

use anyhow::anyhow;
use quad_protocol::Hash;
use quad_run::config::{ConfigError, Experiment, Preset, RunConfig};
use quad_run::folder::{Checkpoint, RunDir};
use quad_runtime::Hint;
use toml::Table;
use tracing::info;

/// The end of a complete run.
pub(super) struct EarlierRun {
    pub checkpoint: Checkpoint,
    /// Episodes that it has not learned from.
    pub held_out: Vec<usize>,
    experiment: Experiment,
    dataset_sha256: Option<String>,
}

/// The usual folder of a run that begins with the end of another.
pub(super) fn usual_folder(source: &Path) -> PathBuf {
    let source = absolute(source).unwrap_or_default();
    let name = source.file_name().unwrap_or_default().to_string_lossy();
    Path::new("runs").join(format!("{name}-online"))
}

/// Reads the run `source`, and makes a preset of its settings. A run that has begun in `folder` goes
/// on without `source`, by its own settings and checkpoint.
pub(super) fn read(
    source: &Path,
    folder: &Path,
    fresh: bool,
) -> anyhow::Result<(Option<EarlierRun>, Preset)> {
    if let [Ok(there), Ok(here)] = [source, folder].map(Path::canonicalize)
        && there == here
    {
        return Err(anyhow!("{} cannot begin with itself", folder.display()))
            .hint("the new run has a folder of its own: name it by --run-dir");
    }
    match (EarlierRun::read(source), begun(folder).filter(|_| !fresh)) {
        (Ok((run, preset)), _) => Ok((Some(run), preset)),
        (Err(error), Some(preset)) => {
            info!("{} goes on without the run of --from: {error:#}", folder.display());
            Ok((None, preset))
        }
        (Err(error), None) => Err(error),
    }
}

/// The settings of a run that another's end began, if it has a checkpoint.
fn begun(folder: &Path) -> Option<Preset> {
    let (dir, config) = RunDir::open(folder).ok()?;
    config.experiment.from.as_ref().and(dir.checkpoint_step().ok()?)?;
    preset(&config, Table::new()).ok()
}

fn preset(config: &RunConfig, changes: Table) -> anyhow::Result<Preset> {
    let mut own = Table::try_from(&config.experiment)?;
    // A share of 0 is not in the table, but the task may have another.
    own.insert("hold_out".to_owned(), config.experiment.hold_out.into());
    own.extend(changes);
    Preset::from_run(config, own).hint_of(ConfigError::hint)
}

impl EarlierRun {
    /// Reads the run, and makes a preset of its settings.
    ///
    /// # Errors
    /// The run is not complete, its checkpoints were deleted, or its algorithm cannot learn online.
    fn read(run: &Path) -> anyhow::Result<(Self, Preset)> {
        let (dir, config) = RunDir::open(run)?;
        if config.experiment.online.is_some() {
            return Err(anyhow!("the run in {} has learned online already", run.display()))
                .hint("--from takes a run of the dataset alone");
        }
        let steps = config.experiment.steps;
        let Some(checkpoint) = dir.newest_checkpoint()? else {
            return Err(anyhow!("the run in {} has no checkpoint", run.display())).hint(
                "--from begins with a run's last one: put checkpoints/ back if it was deleted, or let the run end",
            );
        };
        if checkpoint.step != steps {
            let run = run.display();
            return Err(anyhow!("the run in {run} has not reached its last step, {steps}"))
                .hint("let it end first: `learner train` with its settings continues it");
        }
        let hash = Hash::new(&checkpoint.state).to_string();
        let preset = preset(&config, Table::from_iter([("from".to_owned(), hash.into())]))?;
        let (experiment, dataset_sha256) = (config.experiment, config.dataset.sha256());
        let held_out = config.dataset.held_out;
        Ok((Self { checkpoint, held_out, experiment, dataset_sha256 }, preset))
    }

    /// Checks that there are online steps, that the dataset is the run's, and that the checkpoint's
    /// numbers still mean the same.
    pub fn check(&self, here: &Experiment, sha256: &str) -> anyhow::Result<()> {
        if here.online.is_none() {
            return Err(anyhow!("without online steps there is nothing to continue with"))
                .hint("give a number of environment steps above 0 by --online-steps N");
        }
        let there = &self.experiment;
        let recorded = self.dataset_sha256.as_deref().unwrap_or(sha256);
        let kept = [
            ("dataset", recorded == sha256),
            ("steps", there.steps == here.steps),
            ("reward", there.reward == here.reward),
            ("normalize", there.normalize == here.normalize),
            ("hold_out", there.hold_out == here.hold_out),
        ];
        let Some((key, _)) = kept.iter().find(|(_, is_kept)| !is_kept) else { return Ok(()) };
        Err(anyhow!("the run of --from has learned with another value of {key}"))
            .hint("leave it as it was there: what has been learned depends on it")
    }
}
