//! Episodes of one snapshot and their states: those of an evaluation, or one online episode.

use std::time::{Duration, Instant};

use quad_protocol::{EpisodeScore, Exploration, Hash};

use super::Opening;

/// An episode is given up after this many lost evaluators: the episode itself may crash them.
const MOST_ATTEMPTS: u32 = 20;
/// Lost more often than this, an episode rests before it is handed out again: otherwise one broken
/// machine would soon take all attempts, and a disk that snapshots are read from may recover.
const ATTEMPTS_AT_ONCE: u32 = 3;
const LONGEST_REST: Duration = Duration::from_secs(60);

/// Names episodes of one snapshot. Online episodes come first, since the learner waits for them,
/// and older steps before newer ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Key {
    /// Number of the episode.
    Online(u64),
    /// Gradient step.
    Evaluation(u64),
}

impl Key {
    pub const FIRST_EVALUATION: Self = Self::Evaluation(0);
}

#[derive(Debug)]
pub(super) struct Evaluation {
    /// Gradient step of the snapshot.
    pub step: u64,
    pub weights: Hash,
    /// Exploration in an online episode.
    pub exploration: Option<Exploration>,
    episodes: Vec<Episode>,
    /// Numbers of episodes that wait or are handed out, and of those that are given up. Complete
    /// evaluations become many, and are passed over.
    pending: usize,
    missing: usize,
}

#[derive(Debug)]
struct Episode {
    seed: u64,
    stage: Stage,
    /// Number of evaluators that were lost with it, or could not do it.
    lost: u32,
    rests_until: Option<Instant>,
}

#[derive(Debug, PartialEq)]
enum Stage {
    Waiting,
    /// With the job of this number.
    HandedOut(u64),
    /// It is not waited for anymore. A score is still accepted.
    GivenUp,
    Scored(EpisodeScore),
}

impl Episode {
    fn lost(&mut self, now: Instant) {
        self.lost += 1;
        let doublings = self.lost.saturating_sub(ATTEMPTS_AT_ONCE).min(16);
        let rest = (doublings > 0).then(|| Duration::from_secs(1 << doublings).min(LONGEST_REST));
        self.rests_until = rest.map(|rest| now + rest);
    }

    fn is_ready(&self, now: Instant) -> bool {
        self.stage == Stage::Waiting && self.rests_until.is_none_or(|until| now >= until)
    }
}

impl Evaluation {
    /// An evaluation of the episodes `seeds`, some of which may have a score already.
    pub fn new(step: u64, weights: Hash, seeds: &[u64], scores: &[EpisodeScore]) -> Self {
        let episode = |&seed| Episode { seed, stage: Stage::Waiting, lost: 0, rests_until: None };
        let episodes = seeds.iter().map(episode).collect();
        let mut evaluation =
            Self { step, weights, exploration: None, episodes, pending: 0, missing: 0 };
        evaluation.score(scores);
        evaluation
    }

    /// An online episode.
    pub fn online(opening: &Opening, weights: Hash) -> Self {
        let Opening { step, seed, exploration, .. } = *opening;
        Self { exploration: Some(exploration), ..Self::new(step, weights, &[seed], &[]) }
    }

    fn count(&mut self) {
        let is_pending = |stage: &Stage| matches!(stage, Stage::Waiting | Stage::HandedOut(_));
        self.pending = self.episodes.iter().filter(|episode| is_pending(&episode.stage)).count();
        let given_up = self.episodes.iter().filter(|episode| episode.stage == Stage::GivenUp);
        self.missing = given_up.count();
    }

    /// Number of episodes that have no score yet, and may still get one.
    pub fn pending(&self) -> usize {
        self.pending
    }

    /// Number of episodes that have no score and are not handed out anymore.
    pub fn missing(&self) -> usize {
        self.missing
    }

    /// Number of episodes that wait for an evaluator.
    pub fn waiting(&self) -> usize {
        if self.pending == 0 {
            return 0;
        }
        self.episodes.iter().filter(|episode| episode.stage == Stage::Waiting).count()
    }

    /// True if episodes are handed out with this job.
    pub fn has_job(&self, job: u64) -> bool {
        self.episodes.iter().any(|episode| episode.stage == Stage::HandedOut(job))
    }

    /// Hands out episodes that wait and do not rest. After a failure `few` at most, in case the
    /// episode is its cause.
    pub fn hand_out(&mut self, job: u64, [few, most]: [usize; 2], now: Instant) -> Vec<u64> {
        if self.pending == 0 {
            return Vec::new();
        }
        let ready = self.episodes.iter_mut().filter(|episode| episode.is_ready(now));
        let mut ready = ready.peekable();
        let has_failed = ready.peek().is_some_and(|episode| episode.lost > 0);
        let give = |episode: &mut Episode| {
            episode.stage = Stage::HandedOut(job);
            episode.seed
        };
        ready.take(if has_failed { few } else { most }).map(give).collect()
    }

    /// Hands out episodes once more, whose evaluator is slow.
    pub fn hand_out_again(&mut self, job: u64) -> Vec<u64> {
        let mut seeds = Vec::new();
        for episode in &mut self.episodes {
            if let Stage::HandedOut(earlier) = &mut episode.stage {
                *earlier = job;
                seeds.push(episode.seed);
            }
        }
        seeds
    }

    /// Takes back the episodes of a job that have no score yet. `lost` is when its evaluator was
    /// lost or failed, and `None` if it handed the job back in order. Returns the number of those
    /// that are given up.
    pub fn take_back(&mut self, job: u64, lost: Option<Instant>) -> usize {
        let before = self.missing;
        for episode in &mut self.episodes {
            if episode.stage != Stage::HandedOut(job) {
                continue;
            }
            if let Some(now) = lost {
                episode.lost(now);
            }
            // The learner waits for experience as long as it takes.
            let give_up = episode.lost >= MOST_ATTEMPTS && self.exploration.is_none();
            episode.stage = if give_up { Stage::GivenUp } else { Stage::Waiting };
        }
        self.count();
        self.missing - before
    }

    /// Counts scores.
    pub fn score(&mut self, scores: &[EpisodeScore]) {
        for score in scores {
            let mut episodes = self.episodes.iter_mut();
            if let Some(episode) = episodes.find(|episode| episode.seed == score.seed) {
                episode.stage = Stage::Scored(*score);
            }
        }
        self.count();
    }

    /// True if an episode has a score; `None` if there is no such episode.
    pub fn is_scored(&self, seed: u64) -> Option<bool> {
        let episode = self.episodes.iter().find(|episode| episode.seed == seed)?;
        Some(matches!(episode.stage, Stage::Scored(_)))
    }

    /// The scores in the order of the seeds, once all are there.
    pub fn scores(&self) -> Option<Vec<EpisodeScore>> {
        let score = |episode: &Episode| match episode.stage {
            Stage::Scored(score) => Some(score),
            _ => None,
        };
        self.episodes.iter().map(score).collect()
    }
}
