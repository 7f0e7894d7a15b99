//! Audits: a share of the episodes is scored a second time, by another evaluator that computes by the same instructions. The
//! same weights and seed give it the same score, bit for bit, so a difference is a broken machine, another simulator, or a lie
//! (BOINC's idea).

use std::collections::{BTreeMap, BTreeSet};

use quad_protocol::{EpisodeScore, Hash, Name, ScoreReport};

use super::evaluation::Ended;
use crate::resume::Unchecked;

/// The episodes that are to be scored again.
#[derive(Debug)]
pub(super) struct Audits {
    /// Share of the episodes, 0 to 1.
    share: f64,
    given_up: u64,
    waiting: BTreeMap<(u64, u64), Waiting>,
}

#[derive(Debug)]
struct Waiting {
    first: EpisodeScore,
    evaluator: Name,
    precision: Name,
    /// The job that it is handed out with.
    job: Option<u64>,
    /// How many evaluators were lost with it, or could not do it.
    lost: u32,
}

/// An episode is not checked any more after so many evaluators that were lost with it, or could not do it: an audit must not
/// keep a run from its end.
const MOST_LOST: u32 = 5;

/// An episode that was scored twice.
#[derive(Clone, Debug, PartialEq)]
pub struct Audited {
    /// Gradient step of its snapshot.
    pub step: u64,
    /// The score that counts, and who measured it.
    pub first: (EpisodeScore, Name),
    /// The other one.
    pub second: (EpisodeScore, Name),
}

impl Audited {
    /// Whether both are the same, bit for bit.
    pub fn agree(&self) -> bool {
        let bits = |score: &EpisodeScore| (score.episode_return.to_bits(), score.score.to_bits(), score.length);
        bits(&self.first.0) == bits(&self.second.0)
    }
}

impl Audits {
    /// Of that share of the episodes.
    pub fn new(share: f64) -> Self {
        Self { share, given_up: 0, waiting: BTreeMap::new() }
    }

    /// Takes in scores that are new; the seed and the step decide which of them are scored again.
    pub fn add(&mut self, report: &ScoreReport, new: &[EpisodeScore]) {
        for score in new {
            let (evaluator, precision) = (report.evaluator.clone(), report.precision.clone());
            self.add_one(report.step, Unchecked { score: *score, evaluator, precision });
        }
    }

    /// The same for one that may be of an earlier life.
    pub fn add_one(&mut self, step: u64, Unchecked { score: first, evaluator, precision }: Unchecked) {
        if is_chosen(self.share, step, first.seed) {
            self.waiting.insert((step, first.seed), Waiting { first, evaluator, precision, job: None, lost: 0 });
        }
    }

    /// How many wait for somebody who can do them, and how many are being done.
    pub fn count(&self) -> [usize; 2] {
        let open = self.waiting.values().filter(|waiting| waiting.job.is_some()).count();
        [self.waiting.len() - open, open]
    }

    /// Hands out episodes of one step that `evaluator` can check; nothing if there are none.
    pub fn hand_out(&mut self, job: u64, evaluator: &Name, precision: &Name, most: usize) -> Option<(u64, Vec<u64>)> {
        let fits = |waiting: &Waiting| {
            waiting.job.is_none() && waiting.evaluator != *evaluator && waiting.precision == *precision
        };
        let step = self.waiting.iter().find(|(_, waiting)| fits(waiting)).map(|(&(step, _), _)| step)?;
        let mut seeds = Vec::new();
        for (&(_, seed), waiting) in self.waiting.range_mut((step, 0)..=(step, u64::MAX)) {
            if seeds.len() < most && fits(waiting) {
                waiting.job = Some(job);
                seeds.push(seed);
            }
        }
        Some((step, seeds))
    }

    /// Lets the episodes of a job that has ended wait for another evaluator, unless too many were lost with them.
    pub fn release(&mut self, job: u64, ended: Ended) {
        let before = self.waiting.len();
        self.waiting.retain(|_, waiting| {
            if waiting.job == Some(job) {
                waiting.job = None;
                waiting.lost += u32::from(!matches!(ended, Ended::HandedBack));
            }
            waiting.lost < MOST_LOST
        });
        self.given_up += (before - self.waiting.len()) as u64;
    }

    /// How many are not checked any more, after [`release`](Self::release).
    pub fn given_up(&self) -> u64 {
        self.given_up
    }

    /// Whether a job still has episodes to score again.
    pub fn is_open(&self, job: u64) -> bool {
        self.waiting.values().any(|waiting| waiting.job == Some(job))
    }

    /// Compares what a report has scored again with what was scored first; gives the jobs, too, that were to do so.
    pub fn compare(&mut self, report: &ScoreReport) -> (Vec<Audited>, BTreeSet<u64>) {
        let (mut audited, mut jobs) = (Vec::new(), BTreeSet::new());
        for second in &report.episodes {
            let key = (report.step, second.seed);
            let by_another =
                |first: &Waiting| first.evaluator != report.evaluator && first.precision == report.precision;
            if self.waiting.get(&key).is_some_and(by_another)
                && let Some(Waiting { first, evaluator, job, .. }) = self.waiting.remove(&key)
            {
                jobs.extend(job);
                let second = (*second, report.evaluator.clone());
                audited.push(Audited { step: report.step, first: (first, evaluator), second });
            }
        }
        (audited, jobs)
    }
}

/// A function of step and seed alone, which evaluators could compute, but so that no simple choice of theirs avoids it.
fn is_chosen(share: f64, step: u64, seed: u64) -> bool {
    let hash = Hash::of(&[step.to_le_bytes(), seed.to_le_bytes()].concat()).to_string();
    let number = u32::from_str_radix(&hash[..8], 16).unwrap_or(0);
    f64::from(number) < share * 2f64.powi(32)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use std::time::Instant;

    #[test]
    fn an_episode_that_nobody_checks_is_not_waited_for() {
        let [one, other] = ["one", "other"].map(|name| Name::new(name).unwrap());
        let score = EpisodeScore { seed: 7, episode_return: 1.0, length: 1, score: 1.0 };
        let mut audits = Audits::new(1.0);
        let f32 = Name::new("f32").unwrap();
        audits.add_one(10, Unchecked { score, evaluator: one, precision: f32.clone() });
        for job in 100..200 {
            assert_eq!(audits.hand_out(job, &other, &f32, 4), Some((10, vec![7])));
            audits.release(job, Ended::HandedBack);
        }
        for job in 0..u64::from(MOST_LOST) {
            assert_eq!(audits.hand_out(job, &other, &f32, 4), Some((10, vec![7])));
            audits.release(job, Ended::Lost(Instant::now()));
        }
        assert_eq!((audits.count(), audits.given_up()), ([0, 0], 1));
    }

    #[test]
    fn the_share_is_chosen() {
        for (share, least, most) in [(0.0, 0, 0), (0.05, 400, 600), (1.0, 10_000, 10_000)] {
            let chosen = (0..10_000).filter(|&seed| is_chosen(share, 1000, seed)).count();
            assert!((least..=most).contains(&chosen), "{chosen} of 10000 at {share}");
        }
    }
}
