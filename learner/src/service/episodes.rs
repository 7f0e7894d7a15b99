//! Episodes of one snapshot and their states: those of an evaluation, or one online episode.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::time::{Duration, Instant};

use quad_protocol::{EpisodeScore, Exploration, Hash};

use super::outcomes::Opening;

/// An episode is given up after this many lost evaluators: the episode itself may crash them.
const MOST_ATTEMPTS: u32 = 20;
/// Lost more often than this, an episode rests before it is handed out again: otherwise one broken
/// machine would soon take all attempts, and a disk that snapshots are read from may recover.
const ATTEMPTS_AT_ONCE: u32 = 3;
const LONGEST_REST: Duration = Duration::from_secs(60);

/// Names episodes of one snapshot. Online episodes come first, since the learner waits for it, and older
/// steps before newer ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Key {
    /// Number of the episode.
    Online(u64),
    /// Gradient step.
    Evaluation(u64),
}

#[derive(Debug)]
pub(super) struct Evaluation {
    /// Gradient step of the snapshot.
    pub step: u64,
    pub weights: Hash,
    /// Exploration in an online episode.
    pub exploration: Option<Exploration>,
    episodes: Vec<Episode>,
    /// Indices of the episodes by seed.
    indices: HashMap<u64, usize>,
    /// Indices of the episodes that wait. Complete evaluations become many, and are passed over.
    waiting: BTreeSet<usize>,
    /// Indices of the episodes that are handed out, with their jobs.
    handed_out: BTreeMap<usize, u64>,
    /// Indices of the episodes that are not waited for anymore. Their scores are still accepted.
    given_up: BTreeSet<usize>,
}

#[derive(Debug)]
struct Episode {
    seed: u64,
    score: Option<EpisodeScore>,
    /// Number of evaluators that were lost with it, or could not do it.
    lost: u32,
    rests_until: Option<Instant>,
}

impl Episode {
    fn lost(&mut self, now: Instant) {
        self.lost += 1;
        let doublings = self.lost.saturating_sub(ATTEMPTS_AT_ONCE).min(16);
        let rest = (doublings > 0).then(|| Duration::from_secs(1 << doublings).min(LONGEST_REST));
        self.rests_until = rest.map(|rest| now + rest);
    }

    fn rests(&self, now: Instant) -> bool {
        self.rests_until.is_some_and(|until| now < until)
    }
}

impl Evaluation {
    /// An evaluation of the episodes `seeds`, some of which may have a score already.
    pub fn new(step: u64, weights: Hash, seeds: &[u64], scores: &[EpisodeScore]) -> Self {
        let episode = |&seed| Episode { seed, score: None, lost: 0, rests_until: None };
        let mut evaluation = Self {
            step,
            weights,
            exploration: None,
            episodes: seeds.iter().map(episode).collect(),
            indices: seeds.iter().enumerate().map(|(index, &seed)| (seed, index)).collect(),
            waiting: (0..seeds.len()).collect(),
            handed_out: BTreeMap::new(),
            given_up: BTreeSet::new(),
        };
        evaluation.score(scores);
        evaluation
    }

    /// An online episode.
    pub fn online(opening: &Opening, weights: Hash) -> Self {
        let Opening { step, seed, exploration, .. } = *opening;
        Self { exploration: Some(exploration), ..Self::new(step, weights, &[seed], &[]) }
    }

    /// Number of episodes that have no score yet, and may still get one.
    pub fn pending(&self) -> usize {
        self.waiting.len() + self.handed_out.len()
    }

    /// Number of episodes that wait for an evaluator.
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Seeds of the episodes that have no score and are not handed out anymore.
    pub fn given_up(&self) -> impl Iterator<Item = u64> {
        self.given_up.iter().map(|&index| self.episodes[index].seed)
    }

    /// Hands out episodes once more, whose evaluator is slow.
    pub fn hand_out_again(&mut self, job: u64) -> Vec<u64> {
        self.handed_out.values_mut().for_each(|of| *of = job);
        self.handed_out.keys().map(|&index| self.episodes[index].seed).collect()
    }

    /// Hands out episodes that wait and do not rest. After a failure `few` at most, in case the
    /// episode is its cause.
    pub fn hand_out(&mut self, job: u64, [few, most]: [usize; 2], now: Instant) -> Vec<u64> {
        let ready = self.waiting.iter().copied();
        let mut ready = ready.filter(|&index| !self.episodes[index].rests(now)).peekable();
        let lost = ready.peek().is_some_and(|&index| self.episodes[index].lost > 0);
        let indices = Vec::from_iter(ready.take(if lost { few } else { most }));
        let give = |index: usize| {
            self.waiting.remove(&index);
            self.handed_out.insert(index, job);
            self.episodes[index].seed
        };
        indices.into_iter().map(give).collect()
    }

    /// Takes back the episodes of a job that have no score yet. `lost` is when its evaluator was
    /// lost or failed, and `None` if it handed the job back in order. Returns the seeds that are
    /// given up.
    pub fn take_back(&mut self, job: u64, seeds: &[u64], lost: Option<Instant>) -> Vec<u64> {
        let mut given_up = Vec::new();
        for &seed in seeds {
            let Some(&index) = self.indices.get(&seed) else { continue };
            if self.handed_out.get(&index) != Some(&job) {
                continue;
            }
            self.handed_out.remove(&index);
            let episode = &mut self.episodes[index];
            if let Some(now) = lost {
                episode.lost(now);
            }
            // The learner waits for experience as long as it takes.
            if episode.lost >= MOST_ATTEMPTS && self.exploration.is_none() {
                self.given_up.insert(index);
                given_up.push(seed);
            } else {
                self.waiting.insert(index);
            }
        }
        given_up
    }

    /// Counts scores. Returns the jobs that their episodes were handed out with.
    pub fn score(&mut self, scores: &[EpisodeScore]) -> BTreeSet<u64> {
        let mut jobs = BTreeSet::new();
        for score in scores {
            let Some(&index) = self.indices.get(&score.seed) else { continue };
            self.waiting.remove(&index);
            self.given_up.remove(&index);
            jobs.extend(self.handed_out.remove(&index));
            self.episodes[index].score = Some(*score);
        }
        jobs
    }

    /// True if an episode has a score; `None` if there is no such episode.
    pub fn is_scored(&self, seed: u64) -> Option<bool> {
        let index = self.indices.get(&seed)?;
        Some(self.episodes[*index].score.is_some())
    }

    /// The scores in the order of the seeds, once all are there.
    pub fn scores(&self) -> Option<Vec<EpisodeScore>> {
        let scores = self.episodes.iter().map(|episode| episode.score);
        if self.pending() > 0 { None } else { scores.collect() }
    }
}
