//! `learner verify`: checks a run by its folder alone.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::Path;

use quad_protocol::{Hash, episode_seeds};

use super::error::RunDirError;
use super::experience::read_experience;
use super::lines::ScoreLine;
use super::run_dir::RunDir;
use crate::config::settings;
use crate::results::Judgment;

/// Listed findings of one kind; further ones are only counted.
const LISTED: usize = 5;

/// f32 and bf16 round differently, and so do different instructions of CPUs.
const OTHER_ARITHMETIC: &str =
    "not comparable, because the evaluators computed in another precision or by other instructions";

/// The result of a check.
#[derive(Debug, Default, PartialEq)]
pub struct Findings {
    /// The checked property, such as `episodes are scored`.
    pub what: &'static str,
    /// Number of items that have the property.
    pub held: u64,
    /// Number of items that should have it.
    pub expected: u64,
    /// Violations by kind: their number and the first cases.
    pub wrong: BTreeMap<&'static str, (u64, Vec<String>)>,
}

impl Findings {
    fn new(what: &'static str, expected: u64) -> Self {
        Self { what, expected, ..Self::default() }
    }

    /// True if there are no violations.
    pub fn all_held(&self) -> bool {
        self.wrong.is_empty()
    }

    pub(super) fn add(&mut self, kind: &'static str, what: String) {
        let (count, listed) = self.wrong.entry(kind).or_default();
        *count += 1;
        if listed.len() < LISTED {
            listed.push(what);
        }
    }
}

impl fmt::Display for Findings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of {} {}", self.held, self.expected, self.what)?;
        for (kind, (count, listed)) in &self.wrong {
            write!(f, "\n{kind} ({count}): {}", listed.join("; "))?;
            if *count > listed.len() as u64 {
                f.write_str("; …")?;
            }
        }
        Ok(())
    }
}

/// Checks that each episode of each evaluation of a run is scored exactly once, with the weights
/// that are on disk; of a run without evaluations, its snapshots.
pub fn verify(path: &Path) -> Result<Findings, RunDirError> {
    let (dir, config) = RunDir::open(path)?;
    let experiment = &config.experiment;
    let schedule = experiment.schedule();
    let expected = schedule.evaluations().saturating_mul(experiment.episodes.into());
    let scores = dir.read_scores()?;
    if expected == 0 && scores.is_empty() {
        return verify_snapshots(&dir);
    }
    let mut findings = Findings::new("episodes are scored", expected);
    let mut hashes: BTreeMap<u64, Option<String>> = BTreeMap::new();
    let planned = |step| match schedule.is_evaluated(step) {
        true => episode_seeds(experiment.seed, step, experiment.episodes),
        false => Vec::new(),
    };
    let mut left: BTreeMap<u64, BTreeSet<u64>> = BTreeMap::new();
    let mut seen = BTreeSet::new();
    for line in scores {
        let (step, seed) = (line.step, line.seed);
        let name = named((step, seed));
        let read = || hash(&dir, step).ok().map(|hash| hash.to_string());
        match hashes.entry(step).or_insert_with(read) {
            None => findings.add("scored, but the snapshot is gone", name.clone()),
            Some(hash) if *hash != line.weights => {
                findings.add("scored with other weights than are on disk", name.clone());
            }
            Some(_) => {}
        }
        let left = left.entry(step).or_insert_with(|| BTreeSet::from_iter(planned(step)));
        if !seen.insert((step, seed)) {
            findings.add("scored twice", name);
        } else if left.remove(&seed) {
            findings.held += 1;
        } else {
            findings.add("no episode of this run", name);
        }
    }
    let missing = findings.expected - findings.held;
    if missing > 0 {
        // A run without end plans more episodes than memory holds.
        let unscored = |(step, seed): &(u64, u64)| !seen.contains(&(*step, *seed));
        let seeds = |step| planned(step).into_iter().map(move |seed| (step, seed));
        let first = schedule.evaluated_steps().flat_map(seeds).filter(unscored);
        let first = first.take(LISTED).map(named).collect();
        findings.wrong.insert("without a score until the run continues", (missing, first));
    }
    Ok(findings)
}

/// Compares snapshots with the hashes that judgments and experience name.
fn verify_snapshots(dir: &RunDir) -> Result<Findings, RunDirError> {
    let mut hashes: BTreeMap<u64, BTreeSet<String>> = BTreeMap::new();
    let judged =
        Judgment::read_all(dir)?.into_iter().map(|judgment| (judgment.step, judgment.weights));
    let played = read_experience(dir.path())?.into_iter();
    for (step, hash) in
        judged.chain(played.map(|episode| (episode.step, episode.weights.to_string())))
    {
        hashes.entry(step).or_default().insert(hash);
    }
    let mut findings = Findings::new("snapshots have the recorded hash", 0);
    for step in dir.snapshots()? {
        let Some(recorded) = hashes.get(&step) else { continue };
        findings.expected += 1;
        match *recorded == BTreeSet::from([hash(dir, step)?.to_string()]) {
            true => findings.held += 1,
            false => findings.add(
                "judged or played with other weights than are on disk",
                format!("step {step}"),
            ),
        }
    }
    Ok(findings)
}

fn named((step, seed): (u64, u64)) -> String {
    format!("step {step}, seed {seed}")
}

fn hash(dir: &RunDir, step: u64) -> Result<Hash, RunDirError> {
    Ok(Hash::new(&dir.read_snapshot(step)?))
}

/// Compares the scores and the snapshots of a run with those of another run of the same
/// configuration, bit for bit.
pub fn compare(path: &Path, other: &Path) -> Result<[Findings; 2], RunDirError> {
    let [(dir, config), (other_dir, other_config)] = [RunDir::open(path)?, RunDir::open(other)?];
    let with_key = |line: ScoreLine| ((line.step, line.seed), line);
    let by_key = |lines: Vec<ScoreLine>| BTreeMap::from_iter(lines.into_iter().map(with_key));
    let [ours, theirs] = [by_key(dir.read_scores()?), by_key(other_dir.read_scores()?)];
    let mut findings = Findings::new("episodes are compared", ours.len() as u64);
    let [a, b] = [&config, &other_config].map(settings::from_run);
    for key in settings::differences_in_brief(&a, &b) {
        findings.add("settings that differ", key.clone());
    }
    for (key, line) in &ours {
        let name = named(*key);
        let Some(same) = theirs.get(key) else {
            findings.add("not scored there", name);
            continue;
        };
        let bits = |line: &ScoreLine| (line.episode_return.to_bits(), line.length);
        if line.weights != same.weights {
            findings.add("weights that differ", name);
        } else if line.precision != same.precision {
            let (here, there) = (&line.precision, &same.precision);
            findings.add(OTHER_ARITHMETIC, format!("{name} ({here} here, {there} there)"));
        } else if bits(line) != bits(same) {
            findings.add("scores that differ", name);
        } else {
            findings.held += 1;
        }
    }
    Ok([findings, compare_snapshots(&dir, &other_dir)?])
}

fn compare_snapshots(dir: &RunDir, other: &RunDir) -> Result<Findings, RunDirError> {
    let (ours, theirs) = (dir.snapshots()?, other.snapshots()?);
    let mut findings = Findings::new("snapshots are compared", ours.len() as u64);
    if ours.is_empty() {
        // A complete run has at least one.
        findings.add("nothing to compare", format!("{} has no snapshot", dir.path().display()));
    }
    for step in ours {
        if !theirs.contains(&step) {
            findings.add("snapshots that are not there", format!("step {step}"));
        } else if hash(dir, step)? != hash(other, step)? {
            findings.add("snapshots that differ", format!("step {step}"));
        } else {
            findings.held += 1;
        }
    }
    Ok(findings)
}
