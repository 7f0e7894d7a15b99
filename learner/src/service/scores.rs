//! Evaluations, from their opening to their last score.

use std::collections::BTreeSet;

use quad_protocol::{EpisodeScore, Hash, ScoreReply, ScoreReport, episode_seeds};

use super::Service;
use super::evaluation::{Evaluation, Key};
use super::message::{Answer, Count, End, Order, OtherWeights, Refusal, require};

/// Largest relative difference between a score and the one computed from its return; it allows for
/// rounding only.
pub(super) const SCORE_TOLERANCE: f64 = 1e-6;

impl<Q> Service<Q> {
    /// Opens the evaluation of a snapshot, unless it is open. Scores of an earlier incarnation
    /// count from then on; they end the run if they were measured with other weights.
    pub(super) fn open_evaluation(&mut self, step: u64, weights: Hash) {
        let key = Key::Evaluation(step);
        let open = self.evaluations.get(&key).map(|evaluation| evaluation.weights.to_string());
        let is_open = open.is_some();
        let scored = open.or_else(|| Some(self.earlier.get(&step)?.weights.clone()));
        if let Some(scored) = scored.filter(|scored| *scored != weights.to_string()) {
            let error = OtherWeights { step, trained: weights, scored };
            return self.orders.push(Order::End(End::OtherWeights(error)));
        }
        if is_open {
            return;
        }
        let scores = self.earlier.remove(&step).map(|earlier| earlier.episodes).unwrap_or_default();
        let seeds = episode_seeds(self.rules.seed, step, self.rules.episodes);
        let evaluation = Evaluation::new(step, weights, &seeds, &scores);
        if let Some(scores) = evaluation.scores() {
            self.orders.push(Order::Evaluated { step, scores, earlier: true });
        }
        self.evaluations.insert(key, evaluation);
    }

    /// Checks a report. Its new scores are to be written.
    pub(super) fn check_report(&mut self, query: Q, report: ScoreReport) {
        let refusal = match self.new_scores(&report) {
            // All of its scores are on the disk.
            Ok(new) if new.is_empty() => return self.acknowledge(query, &report, &new),
            Ok(new) => return self.deliveries.writing_scores.push((query, report, new)),
            Err(refusal) => refusal,
        };
        let incarnation = self.rules.incarnation;
        let reply = Answer::Scores(match refusal {
            Refusal::NotYet => ScoreReply::NotYet { incarnation },
            _ => ScoreReply::Refused { incarnation, reason: refusal.to_string() },
        });
        self.orders.extend([Order::rejected(refusal), Order::Reply(query, reply)]);
    }

    /// Checks a report against its evaluation. Returns the scores of episodes that had none.
    fn new_scores(&self, report: &ScoreReport) -> Result<Vec<EpisodeScore>, Refusal> {
        require(report.run == self.rules.run, Refusal::Run)?;
        let evaluation = self.evaluations.get(&Key::Evaluation(report.step));
        let is_due = self.rules.schedule.is_evaluated(report.step);
        let evaluation = evaluation.ok_or(if is_due { Refusal::NotYet } else { Refusal::Step })?;
        require(evaluation.weights == report.weights, Refusal::Weights)?;
        let (mut new, mut seen) = (Vec::new(), BTreeSet::new());
        for score in &report.episodes {
            require(seen.insert(score.seed), Refusal::Seed(score.seed))?;
            let is_scored = evaluation.is_scored(score.seed).ok_or(Refusal::Seed(score.seed))?;
            require(self.is_possible(score), Refusal::Episode(score.seed))?;
            if !is_scored {
                new.push(*score);
            }
        }
        Ok(new)
    }

    pub(super) fn is_possible(&self, score: &EpisodeScore) -> bool {
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

    /// Counts scores that are on the disk. Those of a report that are not `new` are duplicates.
    pub(super) fn acknowledge(&mut self, query: Q, report: &ScoreReport, new: &[EpisodeScore]) {
        let (key, open_jobs) = (Key::Evaluation(report.step), self.jobs.len());
        let mut complete = None;
        if let Some(evaluation) = self.evaluations.get_mut(&key).filter(|_| !new.is_empty()) {
            evaluation.score(new);
            complete = evaluation.scores();
            // The report's own job, and others that had some of its episodes because it came late.
            self.jobs.retain(|_, open| open.key != key || evaluation.has_job(open.job.id));
        }
        let (incarnation, step) = (self.rules.incarnation, report.step);
        let (new, duplicates) = (new.len() as u32, (report.episodes.len() - new.len()) as u32);
        self.orders.push(Order::Count(Count::Scores { new, duplicates }));
        self.count_jobs("completed", open_jobs - self.jobs.len());
        let complete = complete.map(|scores| Order::Evaluated { step, scores, earlier: false });
        self.orders.extend(complete);
        let reply = Answer::Scores(ScoreReply::Recorded { incarnation, new, duplicates });
        self.orders.push(Order::Reply(query, reply));
    }
}
