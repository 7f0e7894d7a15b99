//! A run folder that is there already: whether this learner may continue in it, and what an earlier
//! one left.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::anyhow;
use quad_protocol::{EpisodeScore, Hash};
use quad_runtime::hinted;
use tracing::{info, warn};

use super::checkpoints::Checkpoint;
use super::error::RunDirError;
use super::folder::RunDir;
use super::lines::ScoreLine;
use super::log::Log;
use crate::config::{Experiment, RunConfig, settings};

/// The scores of one step that an earlier incarnation of the learner wrote down.
#[derive(Clone, Debug, PartialEq)]
pub struct Earlier {
    /// Hash of the snapshot that was scored, as text.
    pub weights: String,
    /// Each seed once.
    pub episodes: Vec<EpisodeScore>,
}

/// The folder of a run that has begun, locked.
pub struct Begun {
    dir: RunDir,
    /// None if the run is to be set aside: then it need not be readable.
    config: Option<RunConfig>,
    scores: Log,
}

/// What a run has reached so far; nothing for one that begins.
#[derive(Default)]
pub struct Past {
    /// Where the training continues.
    pub checkpoint: Option<Checkpoint>,
    /// The snapshots on disk that evaluations may be of, by step.
    pub snapshots: BTreeMap<u64, Hash>,
    /// The scores on disk, by step.
    pub scores: BTreeMap<u64, Earlier>,
}

/// Opens and locks the folder if there is a run in it, to continue it or, for a `fresh` one, to set
/// it aside.
///
/// # Errors
/// Another learner is at work there, or a file is not what a learner writes.
pub fn open(path: &Path, fresh: bool) -> Result<Option<Begun>, RunDirError> {
    if !RunDir::is_occupied(path) {
        return Ok(None);
    }
    let dir = RunDir::at(path);
    let scores = dir.score_log()?;
    let config = if fresh { None } else { Some(dir.read_config()?) };
    Ok(Some(Begun { dir, config, scores }))
}

impl Begun {
    /// Checks that the run is the one that `config` describes, unless it is to be set aside.
    ///
    /// # Errors
    /// Every setting that differs.
    pub fn check_same(&self, config: &RunConfig) -> anyhow::Result<()> {
        let Some(begun) = &self.config else { return Ok(()) };
        let (old, new) = (settings::of_run(begun), settings::of_run(config));
        let value = |settings: &settings::Settings, key: &String| settings.get(key).cloned();
        let line = |key: &String| {
            let [old, new] =
                [&old, &new].map(|side| value(side, key).unwrap_or_else(|| "not set".to_owned()));
            format!("{key}: {old} there, {new} here")
        };
        let differences: Vec<_> = settings::differences(&old, &new).map(line).collect();
        if !differences.is_empty() {
            let (path, differences) = (self.dir.path().display(), differences.join("; "));
            let error =
                anyhow!("there is a run of another configuration in {path} ({differences})");
            return Err(hinted(
                error,
                "choose another --run-dir; or --fresh, which renames that folder and begins anew",
            ));
        }
        if begun.run.version != config.run.version {
            let (old, new) = (&begun.run.version, &config.run.version);
            warn!(
                "the run was begun by version {old}, this is {new}: its numbers may differ from here on"
            );
        }
        Ok(())
    }

    /// Renames the folder, so that another run can begin in its place.
    pub fn set_aside(self) -> Result<(), RunDirError> {
        let aside = self.dir.set_aside()?;
        info!("the run that was there is now {}", aside.display());
        Ok(())
    }

    /// The folder, its log of scores, and what the run has reached.
    ///
    /// # Errors
    /// A file cannot be read, or its contents are none that a learner writes.
    pub fn go_on(self, experiment: &Experiment) -> anyhow::Result<(RunDir, Log, Past)> {
        let Self { dir, scores, .. } = self;
        dir.remove_endpoints()?;
        dir.mark_failed(false)?;
        dir.remove_partial_files();
        let past = Past::read(&dir, experiment)?;
        info!("{}", past.summary(&dir));
        Ok((dir, scores, past))
    }
}

impl Past {
    fn read(dir: &RunDir, experiment: &Experiment) -> anyhow::Result<Self> {
        let checkpoint = dir.newest_checkpoint()?;
        let step = checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.step);
        let scores = by_step(dir.read_scores()?).map_err(|reason| dir.broken_scores(reason))?;
        let (schedule, mut snapshots) = (experiment.schedule(), BTreeMap::new());
        for of in dir.snapshots()?.into_iter().filter(|of| schedule.is_evaluated(*of)) {
            // One that training comes by again, and that has no scores, will be made again.
            let scored = scores.get(&of);
            if of > step && scored.is_none() {
                continue;
            }
            match dir.read_snapshot(of).map(|tensors| Hash::of(&tensors)) {
                Ok(hash) if scored.is_some_and(|scored| scored.weights != hash.to_string()) => {
                    warn!(
                        "the snapshot of step {of} is not the one that was scored: its file is damaged"
                    );
                    dir.mark_damaged(of)?;
                }
                Ok(hash) => drop(snapshots.insert(of, hash)),
                Err(error) => warn!("{:#}", anyhow::Error::from(error)),
            }
        }
        for of in schedule.evaluated_steps().take_while(|of| *of <= step) {
            let scored = scores.get(&of).map_or(0, |earlier| earlier.episodes.len());
            if !snapshots.contains_key(&of) && scored < experiment.episodes as usize {
                warn!("without the snapshot of step {of} its evaluation stays incomplete");
            }
        }
        Ok(Self { checkpoint, snapshots, scores })
    }

    fn summary(&self, dir: &RunDir) -> String {
        let step = self.checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.step);
        let scores: usize = self.scores.values().map(|earlier| earlier.episodes.len()).sum();
        format!(
            "the run in {} continues after step {step}; {scores} episodes are scored",
            dir.path().display()
        )
    }
}

/// The scores of each step, which all are of the same weights, with each seed once; or what is
/// wrong with them.
fn by_step(lines: Vec<ScoreLine>) -> Result<BTreeMap<u64, Earlier>, String> {
    let mut scores: BTreeMap<u64, Earlier> = BTreeMap::new();
    let mut seen = BTreeSet::new();
    for line in lines {
        let (step, seed) = (line.step, line.seed);
        let none = || Earlier { weights: line.weights.clone(), episodes: Vec::new() };
        let earlier = scores.entry(step).or_insert_with(none);
        if earlier.weights != line.weights {
            return Err(format!("it has scores of two different snapshots of step {step}"));
        }
        if !seen.insert((step, seed)) {
            return Err(format!("it has two scores of step {step}, seed {seed}"));
        }
        earlier.episodes.push(line.episode());
    }
    Ok(scores)
}
