//! `learner verify` on an online run: what its experience promises.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use quad_dataset::environment;
use quad_protocol::{Episode, Hash, online_seed};

use super::error::RunDirError;
use super::experience::read_experience;
use super::run_dir::RunDir;
use super::verify::Findings;

/// Another evaluator plays these episodes with the same bits.
const REPEATABLE: &str =
    "the run can be repeated bit for bit by evaluators with the same arithmetic";
/// As [`REPEATABLE`], of an environment that QUAD does not simulate.
const IF_REPEATABLE: &str = "the run can be repeated bit for bit by evaluators with the same arithmetic, if \
                             its environment repeats itself";
/// Some episodes depend on more than weights and seed.
const LOGGED: &str = "the run can be repeated bit for bit from experience.log alone";

/// Checks that each episode of a run's experience is there once and was played with the snapshot
/// on disk. Also returns the promise that holds. `None` for an offline run. An episode that training
/// leaves out counts as one without rows.
pub fn verify_experience(
    path: &Path,
    is_left_out: impl Fn(&Episode) -> bool,
) -> Result<Option<(Findings, &'static str)>, RunDirError> {
    let (dir, config) = RunDir::open(path)?;
    let experiment = &config.experiment;
    let Some(online) = &experiment.online else { return Ok(None) };
    let episodes = read_experience(path)?;
    let mut findings = Findings { what: "environment steps are recorded", ..Findings::default() };
    let most = episodes.len() as u64 + u64::from(online.lag);
    let numbers: BTreeMap<_, _> = (0..most).map(|j| (online_seed(experiment.seed, j), j)).collect();
    let mut lengths = BTreeMap::new();
    for episode in &episodes {
        let seed = episode.score.seed;
        let name = format!("step {}, seed {seed}", episode.step);
        let rows = if is_left_out(episode) { 0 } else { episode.rewards.len() as u64 };
        match numbers.get(&seed) {
            None => findings.add("no episode of this run", name),
            Some(j) if lengths.insert(*j, rows).is_some() => {
                findings.add("recorded twice", name);
            }
            Some(_) => {}
        }
    }
    // Training takes episodes in their order, up to the first that is not there.
    let (mut next, mut rows) = (0, 0);
    while let Some(length) = lengths.get(&next).filter(|_| rows < online.steps) {
        (next, rows) = (next + 1, rows + length);
    }
    (findings.held, findings.expected) = (rows.min(online.steps), online.steps);
    if rows < online.steps {
        let missing = online.steps - rows;
        findings.add("not recorded yet", format!("{missing} steps, from episode {next} on"));
    }
    let arithmetic = BTreeSet::from_iter(episodes.iter().map(|episode| &episode.precision));
    let acted = BTreeSet::from_iter(episodes.iter().map(|episode| (episode.step, episode.weights)));
    let is_same = |(step, weights): &(u64, Hash)| {
        dir.read_snapshot(*step).map_or(true, |file| Hash::new(&file) == *weights)
    };
    let is_repeatable = arithmetic.len() <= 1
        && episodes.iter().all(|episode| episode.interventions.is_empty())
        && acted.iter().all(is_same);
    let promise = match environment::find(&experiment.environment) {
        _ if !is_repeatable => LOGGED,
        Ok(_) => REPEATABLE,
        Err(_) => IF_REPEATABLE,
    };
    Ok(Some((findings, promise)))
}
