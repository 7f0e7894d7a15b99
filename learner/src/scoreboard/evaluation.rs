//! An evaluation: the snapshot that it is of, and how far each of its episodes is.

use std::collections::HashMap;
use std::mem;

use quad_protocol::{EpisodeScore, Hash};

/// An episode whose evaluator was lost so often is not handed out any more: it may be what they are lost of.
const MOST_ATTEMPTS: u32 = 20;

#[derive(Debug)]
pub(super) struct Evaluation {
    pub weights: Hash,
    episodes: Vec<Episode>,
    /// Where among them a seed is.
    places: HashMap<u64, usize>,
    /// How many of them wait, and how many are handed out. Complete evaluations become many, and are passed over.
    waiting: usize,
    handed_out: usize,
}

#[derive(Debug)]
struct Episode {
    seed: u64,
    state: EpisodeState,
    /// How often an evaluator that had it was lost.
    lost: u32,
}

#[derive(Clone, Copy, Debug)]
enum EpisodeState {
    Waiting,
    HandedOut {
        job: u64,
    },
    /// Not handed out any more. Its score is still welcome.
    GivenUp,
    Scored(EpisodeScore),
}

impl Evaluation {
    /// Of the episodes `seeds`, some of which may have a score already.
    pub fn new(weights: Hash, seeds: &[u64], scores: &[EpisodeScore]) -> Self {
        let episode = |&seed| {
            let score = scores.iter().find(|score| score.seed == seed);
            Episode { seed, state: score.map_or(EpisodeState::Waiting, |score| EpisodeState::Scored(*score)), lost: 0 }
        };
        let episodes: Vec<Episode> = seeds.iter().map(episode).collect();
        let places = seeds.iter().enumerate().map(|(place, &seed)| (seed, place)).collect();
        let waiting = episodes.iter().filter(|episode| matches!(episode.state, EpisodeState::Waiting)).count();
        Self { weights, episodes, places, waiting, handed_out: 0 }
    }

    fn change(&mut self, place: usize, state: EpisodeState) {
        let before = mem::replace(&mut self.episodes[place].state, state);
        for (state, change) in [(before, -1), (state, 1)] {
            match state {
                EpisodeState::Waiting => self.waiting = self.waiting.saturating_add_signed(change),
                EpisodeState::HandedOut { .. } => self.handed_out = self.handed_out.saturating_add_signed(change),
                EpisodeState::GivenUp | EpisodeState::Scored(_) => {}
            }
        }
    }

    /// Episodes that have no score yet, and may still get one.
    pub fn pending(&self) -> usize {
        self.waiting + self.handed_out
    }

    /// The seeds of those that have no score and are not handed out any more.
    pub fn given_up(&self) -> impl Iterator<Item = u64> {
        self.episodes.iter().filter(|e| matches!(e.state, EpisodeState::GivenUp)).map(|e| e.seed)
    }

    /// Hands out some of the episodes that wait; none if there are none.
    pub fn hand_out(&mut self, job: u64, most: usize) -> Vec<u64> {
        let mut seeds = Vec::new();
        for place in 0..self.episodes.len() {
            if self.waiting == 0 || seeds.len() == most {
                break;
            }
            if matches!(self.episodes[place].state, EpisodeState::Waiting) {
                self.change(place, EpisodeState::HandedOut { job });
                seeds.push(self.episodes[place].seed);
            }
        }
        seeds
    }

    /// Takes the unscored episodes of a job back, from an evaluator that was `lost` with them or not. Gives the seeds of those
    /// that were lost too often.
    pub fn take_back(&mut self, job: u64, lost: bool) -> Vec<u64> {
        let mut given_up = Vec::new();
        for place in 0..self.episodes.len() {
            let Episode { seed, state, lost: times } = &mut self.episodes[place];
            if matches!(state, EpisodeState::HandedOut { job: of } if *of == job) {
                *times += u32::from(lost);
                let (seed, hopeless) = (*seed, *times >= MOST_ATTEMPTS);
                given_up.extend(hopeless.then_some(seed));
                self.change(place, if hopeless { EpisodeState::GivenUp } else { EpisodeState::Waiting });
            }
        }
        given_up
    }

    /// Counts scores.
    pub fn score(&mut self, scores: &[EpisodeScore]) {
        for score in scores {
            if let Some(&place) = self.places.get(&score.seed) {
                self.change(place, EpisodeState::Scored(*score));
            }
        }
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
