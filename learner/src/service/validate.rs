//! Checks of score reports.

use std::collections::BTreeSet;

use quad_protocol::{Episode, EpisodeScore, Piece, ScoreReport};

use super::episodes::Key;
use super::outcomes::OnlineEpisodeState;
use super::refusal::{Refusal, require};
use super::scoreboard::Scoreboard;

/// Largest relative difference between a score and the one computed from its return; it allows for
/// rounding only.
const SCORE_TOLERANCE: f64 = 1e-6;

/// A report that passed every check, split into new scores and scores that are recorded already.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Validated {
    /// Episodes that had no score yet.
    pub new: Vec<EpisodeScore>,
    /// Number of episodes that had a score already.
    pub duplicates: u32,
}

impl Scoreboard {
    /// Checks a report against its evaluation and finds its new scores. Changes nothing: the caller
    /// writes the new scores to the disk first, then calls [`record`](Self::record).
    pub fn validate(&self, report: &ScoreReport) -> Result<Validated, Refusal> {
        require(report.run == self.rules.run, Refusal::Run)?;
        let evaluation = self.evaluations.get(&Key::Evaluation(report.step));
        let is_due = self.rules.schedule.is_evaluated(report.step);
        let evaluation = evaluation.ok_or(if is_due { Refusal::NotYet } else { Refusal::Step })?;
        require(evaluation.weights == report.weights, Refusal::Weights)?;
        let mut validated = Validated { new: Vec::new(), duplicates: 0 };
        let mut seen = BTreeSet::new();
        for score in &report.episodes {
            require(seen.insert(score.seed), Refusal::Seed(score.seed))?;
            let is_scored = evaluation.is_scored(score.seed).ok_or(Refusal::Seed(score.seed))?;
            require(self.is_possible(score), Refusal::Episode(score.seed))?;
            if is_scored { validated.duplicates += 1 } else { validated.new.push(*score) }
        }
        Ok(validated)
    }

    /// The online episode of a piece, if the run has it and it is not too long.
    pub fn online(&self, piece: &Piece) -> Result<OnlineEpisodeState, Refusal> {
        require(piece.run == self.rules.run, Refusal::Run)?;
        let fits = piece.length as usize <= self.rules.longest_frame();
        require(fits, Refusal::Rows(piece.seed))?;
        self.online.get(&piece.seed).copied().ok_or(Refusal::Online(piece.seed))
    }

    /// Checks the online episode with this number against its opening. Changes nothing, as
    /// [`validate`](Self::validate).
    pub fn validate_online(&self, number: u64, episode: &Episode) -> Result<(), Refusal> {
        let seed = episode.score.seed;
        let open = self.evaluations.get(&Key::Online(number));
        let open = open.filter(|open| open.is_scored(seed).is_some());
        let open = open.ok_or(Refusal::Online(seed))?;
        require(open.step == episode.step, Refusal::Step)?;
        require(open.weights == episode.weights, Refusal::Weights)?;
        require(episode.dims() == self.rules.dims, Refusal::Rows(seed))?;
        let sum: f64 = episode.rewards.iter().copied().map(f64::from).sum();
        let size: f64 = episode.rewards.iter().map(|reward| f64::from(reward.abs())).sum();
        let is_sum = (sum - episode.score.episode_return).abs() <= SCORE_TOLERANCE * size.max(1.0);
        require(is_sum && self.is_possible(&episode.score), Refusal::Episode(seed))
    }

    fn is_possible(&self, score: &EpisodeScore) -> bool {
        let task = &self.rules.task;
        // In an environment without reference scores the evaluator's user defines the score.
        let expected =
            if task.is_normalized() { task.score(score.episode_return) } else { score.score };
        let longest = task.max_episode_steps().unwrap_or(usize::MAX);
        let length_fits = (1..=longest).contains(&(score.length as usize));
        length_fits
            && EpisodeScore::is_in_range(score.episode_return)
            && EpisodeScore::is_in_range(score.score)
            && (score.score - expected).abs() <= SCORE_TOLERANCE * expected.abs().max(1.0)
    }
}
