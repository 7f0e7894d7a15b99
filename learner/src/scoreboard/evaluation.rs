//! An evaluation: the snapshot that it is of, and how far each of its episodes is.

use quad_protocol::{EpisodeScore, Hash};

#[derive(Debug)]
pub(super) struct Evaluation {
    pub weights: Hash,
    pub episodes: Vec<Episode>,
}

#[derive(Debug)]
pub(super) struct Episode {
    pub seed: u64,
    pub state: EpisodeState,
    /// How often an evaluator that had it was lost.
    pub lost: u32,
}

#[derive(Debug)]
pub(super) enum EpisodeState {
    Waiting,
    HandedOut {
        job: u64,
    },
    /// Not handed out any more. Its score is still welcome.
    GivenUp,
    Scored(EpisodeScore),
}

impl Evaluation {
    pub fn episode(&self, seed: u64) -> Option<&Episode> {
        self.episodes.iter().find(|episode| episode.seed == seed)
    }

    /// The scores, if all are there.
    pub fn scores(&self) -> Option<Vec<EpisodeScore>> {
        let score = |episode: &Episode| match episode.state {
            EpisodeState::Scored(score) => Some(score),
            _ => None,
        };
        self.episodes.iter().map(score).collect()
    }
}
