//! Resuming the run in a folder.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use quad_protocol::{EpisodeScore, Hash};
use quad_runtime::one_line;
use tracing::{info, warn};

use super::checkpoints::Checkpoint;
use super::error::RunDirError;
use super::experience::read_experience;
use super::lines::ScoreLine;
use super::log::Log;
use super::run_dir::RunDir;
use crate::config::{Experiment, RunConfig, settings};
use crate::counted;

/// The saved scores of one evaluation.
#[derive(Clone, Debug, PartialEq)]
pub struct SavedScores {
    /// Hash of the snapshot, as text.
    pub weights: String,
    /// Episodes with distinct seeds.
    pub episodes: Vec<EpisodeScore>,
}

/// The folder of a run that has begun, locked.
pub struct ExistingRun {
    dir: RunDir,
    /// Not read if the run is to be set aside: it may be damaged.
    config: Option<RunConfig>,
    scores: Log,
}

/// The progress of a run on disk; empty for a new run.
#[derive(Default)]
pub struct ResumePoint {
    /// Training state to continue from.
    pub checkpoint: Option<Checkpoint>,
    /// Snapshots of evaluations, by step.
    pub snapshots: BTreeMap<u64, Hash>,
    /// Scores by step.
    pub scores: BTreeMap<u64, SavedScores>,
}

impl ExistingRun {
    /// Opens and locks the folder if there is a run in it: to resume it or, with `fresh`, to set it
    /// aside.
    pub fn open(path: &Path, fresh: bool) -> Result<Option<Self>, RunDirError> {
        if !RunDir::is_occupied(path) {
            return Ok(None);
        }
        let dir = RunDir::at(path);
        let scores = dir.score_log()?;
        let config = match fresh {
            true => None,
            false => Some(dir.read_config()?),
        };
        Ok(Some(Self { dir, config, scores }))
    }

    /// Episodes that the run has not learned from, unless it is to be set aside.
    pub fn held_out(&self) -> Option<&[usize]> {
        Some(&self.config.as_ref()?.dataset.held_out)
    }

    /// Checks that the run has the settings of `config`, unless it is to be set aside.
    pub fn check_same_config(&self, config: &RunConfig) -> Result<(), RunDirError> {
        let Some(begun) = &self.config else { return Ok(()) };
        let (old, new) = (settings::from_run(begun), settings::from_run(config));
        let line = |key: &String| {
            let [old, new] =
                [&old, &new].map(|side| side.get(key).map_or("not set", String::as_str));
            format!("{key}: {old} there, {new} here")
        };
        let differences = Vec::from_iter(settings::differences(&old, &new).map(line)).join("; ");
        if !differences.is_empty() {
            let path = self.dir.path().to_owned();
            return Err(RunDirError::OtherConfig { path, differences });
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

    /// Prepares the folder for a learner and reads the run's progress. Also returns the log of
    /// scores.
    pub fn resume(
        self,
        experiment: &Experiment,
    ) -> Result<(RunDir, Log, ResumePoint), RunDirError> {
        let Self { dir, scores, .. } = self;
        dir.remove_endpoints()?;
        dir.clear_failure()?;
        dir.remove_partial_files();
        let point = ResumePoint::read(&dir, experiment)?;
        let scored = point.scores.values();
        let episodes: usize = scored.map(|scores| scores.episodes.len()).sum();
        let (path, step) = (dir.path().display(), point.step());
        let scored = counted(episodes, "scored episode");
        info!("the run in {path} continues after step {step}, with {scored}");
        Ok((dir, scores, point))
    }
}

impl ResumePoint {
    fn read(dir: &RunDir, experiment: &Experiment) -> Result<Self, RunDirError> {
        let checkpoint = dir.newest_checkpoint()?;
        let scores = by_step(dir.read_scores()?).map_err(|reason| dir.broken_scores(reason))?;
        let snapshots = BTreeMap::new();
        let mut point = Self { checkpoint, snapshots, scores };
        let (schedule, step) = (experiment.schedule(), point.step());
        let plays = |snapshot| {
            let online = experiment.online.as_ref();
            online.is_some_and(|online| online.is_snapshot(experiment.steps, snapshot))
        };
        let mut played = BTreeSet::new();
        if experiment.online.is_some() {
            let episodes = read_experience(dir.path())?;
            played.extend(episodes.iter().map(|episode| (episode.step, episode.weights)));
        }
        let is_needed = |snapshot: &u64| schedule.is_evaluated(*snapshot) || plays(*snapshot);
        for snapshot in dir.snapshots()?.into_iter().filter(is_needed) {
            let scored = point.scores.get(&snapshot);
            // The resumed training makes this snapshot again.
            if snapshot > step && scored.is_none() {
                continue;
            }
            let is_other = |hash: &Hash| {
                scored.is_some_and(|scored| scored.weights != hash.to_string())
                    || played.iter().any(|(step, _)| *step == snapshot)
                        && !played.contains(&(snapshot, *hash))
            };
            match dir.read_snapshot(snapshot).map(|file| Hash::new(&file)) {
                Ok(hash) if is_other(&hash) => {
                    warn!(
                        "the snapshot of step {snapshot} is not the one that was scored or that played online: its file is damaged"
                    );
                    dir.mark_damaged(snapshot)?;
                }
                Ok(hash) => drop(point.snapshots.insert(snapshot, hash)),
                Err(error) => warn!("{}", one_line(&error)),
            }
        }
        for due in schedule.evaluated_steps().take_while(|due| *due <= step) {
            let scored = point.scores.get(&due).map_or(0, |scores| scores.episodes.len());
            if !point.snapshots.contains_key(&due) && scored < experiment.episodes as usize {
                warn!("without the snapshot of step {due} its evaluation stays incomplete");
            }
        }
        Ok(point)
    }

    fn step(&self) -> u64 {
        self.checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.step)
    }
}

/// Groups scores by step. Fails if a step has two snapshots or a seed twice.
fn by_step(lines: Vec<ScoreLine>) -> Result<BTreeMap<u64, SavedScores>, String> {
    let mut scores: BTreeMap<u64, SavedScores> = BTreeMap::new();
    let mut seen = BTreeSet::new();
    for line in lines {
        let (step, seed) = (line.step, line.seed);
        let none = || SavedScores { weights: line.weights.clone(), episodes: Vec::new() };
        let saved = scores.entry(step).or_insert_with(none);
        if saved.weights != line.weights {
            return Err(format!("it has scores of two different snapshots of step {step}"));
        }
        if !seen.insert((step, seed)) {
            return Err(format!("it has two scores of step {step}, seed {seed}"));
        }
        saved.episodes.push(line.episode());
    }
    Ok(scores)
}
