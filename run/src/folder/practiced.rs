//! `learner verify` on a run with practice: what its experience promises.

use std::collections::BTreeSet;
use std::path::Path;

use quad_protocol::{Hash, practice_seed};

use super::error::RunDirError;
use super::experience::read_experience;
use super::run_dir::RunDir;
use super::verify::Findings;

/// Another evaluator plays these episodes with the same bits.
const REPEATABLE: &str =
    "the run can be repeated bit for bit by evaluators with the same arithmetic";
/// Some episodes depend on more than weights and seed.
const LOGGED: &str = "the run can be repeated bit for bit from experience.log alone";

/// Checks that each episode of a run's experience is there once and was played with the snapshot
/// on disk. Also returns the promise that holds. `None` for a run without practice.
pub fn practiced(path: &Path) -> Result<Option<(Findings, &'static str)>, RunDirError> {
    let (dir, config) = RunDir::open(path)?;
    let experiment = &config.experiment;
    let Some(online) = &experiment.online else { return Ok(None) };
    let episodes = read_experience(path)?;
    let lengths = episodes.iter().map(|episode| episode.rewards.len() as u64);
    let rows: u64 = lengths.sum();
    let mut found = Findings { what: "environment steps are recorded", ..Findings::default() };
    (found.found, found.expected) = (rows.min(online.steps), online.steps);
    if rows < online.steps {
        found.add("not recorded yet", format!("{} steps", online.steps - rows));
    }
    let most = episodes.len() as u64 + u64::from(online.lag);
    let seeds = BTreeSet::from_iter((0..most).map(|j| practice_seed(experiment.seed, j)));
    let mut seen = BTreeSet::new();
    for episode in &episodes {
        let seed = episode.score.seed;
        let name = || format!("step {}, seed {seed}", episode.step);
        if !seeds.contains(&seed) {
            found.add("no episode of this run", name());
        }
        if !seen.insert(seed) {
            found.add("recorded twice", name());
        }
    }
    let arithmetic = BTreeSet::from_iter(episodes.iter().map(|it| &it.precision));
    let acted = BTreeSet::from_iter(episodes.iter().map(|it| (it.step, it.weights)));
    let is_same = |(step, weights): &(u64, Hash)| {
        dir.read_snapshot(*step).map_or(true, |file| Hash::of(&file) == *weights)
    };
    let is_repeatable = arithmetic.len() <= 1
        && episodes.iter().all(|it| it.interventions.is_empty())
        && acted.iter().all(is_same);
    Ok(Some((found, if is_repeatable { REPEATABLE } else { LOGGED })))
}

#[cfg(test)]
mod tests;
