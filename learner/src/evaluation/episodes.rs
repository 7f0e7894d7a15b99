//! One evaluation: the snapshot that it is of, and how far each of its episodes is.

use std::collections::{BTreeSet, HashMap};
use std::mem;
use std::time::{Duration, Instant};

use quad_protocol::{EpisodeScore, Hash};

/// An episode whose evaluator was lost so often is given up: the episode itself may crash
/// evaluators.
const MOST_ATTEMPTS: u32 = 20;
/// Lost more often than this, an episode rests before it is handed out again. One machine that
/// fails again and again would else soon have taken all attempts, and what may pass, like a disk
/// that snapshots are read from, gets time to.
const ATTEMPTS_AT_ONCE: u32 = 3;
const LONGEST_REST: Duration = Duration::from_secs(60);

#[derive(Debug)]
pub(super) struct Evaluation {
    pub weights: Hash,
    episodes: Vec<Episode>,
    /// Where among them a seed is.
    places: HashMap<u64, usize>,
    /// Which of them wait, and which are given up. Complete evaluations become many, and are passed
    /// over.
    waiting: BTreeSet<usize>,
    given_up: BTreeSet<usize>,
    handed_out: usize,
}

#[derive(Debug)]
struct Episode {
    seed: u64,
    state: EpisodeState,
    /// How often an evaluator that had it was lost, or could not do it.
    lost: u32,
    /// It is not handed out before.
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

#[derive(Clone, Copy, Debug)]
enum EpisodeState {
    Waiting,
    HandedOut {
        job: u64,
    },
    /// The episode is not waited for any more. Its score is still accepted.
    GivenUp,
    Scored(EpisodeScore),
}

impl Evaluation {
    /// Opens an evaluation of the episodes `seeds`, some of which may have a score already.
    pub fn new(weights: Hash, seeds: &[u64], scores: &[EpisodeScore]) -> Self {
        let episode = |&seed| {
            let score = scores.iter().find(|score| score.seed == seed);
            let state = score.map_or(EpisodeState::Waiting, |score| EpisodeState::Scored(*score));
            Episode { seed, state, lost: 0, rests_until: None }
        };
        let episodes: Vec<Episode> = seeds.iter().map(episode).collect();
        let places = seeds.iter().enumerate().map(|(place, &seed)| (seed, place)).collect();
        let is_waiting = |&place: &usize| matches!(episodes[place].state, EpisodeState::Waiting);
        let waiting = (0..episodes.len()).filter(is_waiting).collect();
        Self { weights, episodes, places, waiting, given_up: BTreeSet::new(), handed_out: 0 }
    }

    fn change(&mut self, place: usize, state: EpisodeState) {
        match mem::replace(&mut self.episodes[place].state, state) {
            EpisodeState::Waiting => drop(self.waiting.remove(&place)),
            EpisodeState::HandedOut { .. } => self.handed_out -= 1,
            EpisodeState::GivenUp => drop(self.given_up.remove(&place)),
            EpisodeState::Scored(_) => {}
        }
        match state {
            EpisodeState::Waiting => drop(self.waiting.insert(place)),
            EpisodeState::HandedOut { .. } => self.handed_out += 1,
            EpisodeState::GivenUp => drop(self.given_up.insert(place)),
            EpisodeState::Scored(_) => {}
        }
    }

    /// Episodes that have no score yet, and may still get one.
    pub fn pending(&self) -> usize {
        self.waiting.len() + self.handed_out
    }

    /// Episodes that wait for an evaluator.
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// The seeds of those that have no score and are not handed out any more.
    pub fn given_up(&self) -> impl Iterator<Item = u64> {
        self.given_up.iter().map(|&place| self.episodes[place].seed)
    }

    /// Hands out some of the episodes that wait, without those that rest; none if there are none.
    /// After a failure `few` at most, in case the episode is its cause.
    pub fn hand_out(&mut self, job: u64, [few, most]: [usize; 2], now: Instant) -> Vec<u64> {
        let ready = self.waiting.iter().copied();
        let mut ready = ready.filter(|place| !self.episodes[*place].rests(now)).peekable();
        let lost = ready.peek().is_some_and(|&place| self.episodes[place].lost > 0);
        let places: Vec<usize> = ready.take(if lost { few } else { most }).collect();
        for &place in &places {
            self.change(place, EpisodeState::HandedOut { job });
        }
        places.into_iter().map(|place| self.episodes[place].seed).collect()
    }

    /// Takes those of a job's episodes back that have no score yet; `lost` is when its evaluator
    /// was lost or failed, and nothing if it handed the job back in order. Gives the seeds of those
    /// that were lost too often.
    pub fn take_back(&mut self, job: u64, seeds: &[u64], lost: Option<Instant>) -> Vec<u64> {
        let mut given_up = Vec::new();
        for &seed in seeds {
            let Some(&place) = self.places.get(&seed) else { continue };
            let episode = &mut self.episodes[place];
            if matches!(episode.state, EpisodeState::HandedOut { job: of } if of == job) {
                lost.into_iter().for_each(|now| episode.lost(now));
                let hopeless = episode.lost >= MOST_ATTEMPTS;
                given_up.extend(hopeless.then_some(seed));
                self.change(
                    place,
                    if hopeless { EpisodeState::GivenUp } else { EpisodeState::Waiting },
                );
            }
        }
        given_up
    }

    /// Counts scores. Gives the jobs that their episodes were handed out with.
    pub fn score(&mut self, scores: &[EpisodeScore]) -> BTreeSet<u64> {
        let mut jobs = BTreeSet::new();
        for score in scores {
            if let Some(&place) = self.places.get(&score.seed) {
                if let EpisodeState::HandedOut { job } = self.episodes[place].state {
                    jobs.insert(job);
                }
                self.change(place, EpisodeState::Scored(*score));
            }
        }
        jobs
    }

    /// Whether an episode has a score; nothing if there is no such episode.
    pub fn is_scored(&self, seed: u64) -> Option<bool> {
        let place = self.places.get(&seed)?;
        Some(matches!(self.episodes[*place].state, EpisodeState::Scored(_)))
    }

    /// The scores, if all are there.
    pub fn scores(&self) -> Option<Vec<EpisodeScore>> {
        let score = |episode: &Episode| match episode.state {
            EpisodeState::Scored(score) => Some(score),
            _ => None,
        };
        if self.pending() > 0 { None } else { self.episodes.iter().map(score).collect() }
    }
}
