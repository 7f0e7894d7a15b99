//! What becomes of a report: its scores are written down, counted, shown and published.

use std::collections::BTreeSet;
use std::mem;
use std::time::Instant;

use quad_protocol::{EpisodeScore, Name, RecordedScores, ScoreReply, ScoreReport, encode, keys};
use tracing::error;

use super::Hub;
use super::rejection::Rejection;
use crate::conduct::DISK_PATIENCE;
use crate::notice::Notice;
use crate::replies::Question;
use crate::run_dir::{AuditLine, ScoreLine};
use crate::scoreboard::{Audited, Screened};
use crate::scribe::Lines;

/// Reports with new scores on their way to the disk, and who waits for the thanks.
#[derive(Default)]
pub(super) struct Delivered {
    /// For the next write.
    staged: Vec<(Question, ScoreReport, Screened)>,
    /// In the write that goes on now.
    in_writing: Vec<(Question, ScoreReport, Screened)>,
    /// Since when.
    since: Option<Instant>,
    /// Step and seed of the new scores of both.
    keys: BTreeSet<(u64, u64)>,
}

impl Delivered {
    /// Whether some have no answer yet.
    pub fn is_waiting(&self) -> bool {
        !self.staged.is_empty() || !self.in_writing.is_empty()
    }

    /// Whether the write takes longer than a disk that works.
    pub fn hangs(&self, now: Instant) -> bool {
        !self.in_writing.is_empty() && self.since.is_some_and(|since| now - since > DISK_PATIENCE)
    }
}

impl Hub {
    /// Checks a report. New scores wait for [`commit`](Self::commit); everything else is answered at once.
    pub(super) fn report(&mut self, question: Question, report: ScoreReport) {
        let reply = match self.screen(&report) {
            Ok(screened) if screened.new.is_empty() => Ok(self.record(&report, screened, &mut None)),
            Ok(screened) => {
                self.scoreboard.keep(&report, Instant::now());
                self.delivered.keys.extend(screened.new.iter().map(|score| (report.step, score.seed)));
                return self.delivered.staged.push((question, report, screened));
            }
            Err(Rejection::Refused(refusal)) => {
                self.reject(&Rejection::Refused(refusal));
                Ok(ScoreReply::Refused { incarnation: self.scoreboard.incarnation(), reason: refusal.to_string() })
            }
            Err(rejection) => Err(rejection),
        };
        self.answer(question, keys::scores(&self.run), reply.map(|reply| (reply, report.evaluator)));
    }

    /// What is new in a report.
    fn screen(&mut self, report: &ScoreReport) -> Result<Screened, Rejection> {
        let screened = self.scoreboard.screen(report)?;
        // Whether these count is decided when the others are on the disk. The others may be the same, delivered before.
        if report.episodes.iter().any(|score| self.delivered.keys.contains(&(report.step, score.seed))) {
            self.scoreboard.keep(report, Instant::now());
            return Err(Rejection::InWriting);
        }
        Ok(screened)
    }

    /// Has the new scores that came meanwhile written to the disk, all together, unless others are being written now.
    pub(super) fn commit(&mut self) {
        let Delivered { staged, in_writing, since, .. } = &mut self.delivered;
        if staged.is_empty() || !in_writing.is_empty() {
            return;
        }
        (*in_writing, *since) = (mem::take(staged), Some(Instant::now()));
        let of = |(_, report, screened): &(_, ScoreReport, Screened)| {
            screened.new.iter().map(|score| ScoreLine::new(report, score)).collect::<Vec<_>>()
        };
        let lines = in_writing.iter().flat_map(of).collect();
        // The thread that writes ends after this one.
        self.scribe.send(Lines::Scores(lines)).ok();
    }

    /// Scores are on the disk, or could not be written: only now are they counted and acknowledged.
    pub(super) fn written(&mut self, written: &Result<(), String>) {
        for (question, report, screened) in mem::take(&mut self.delivered.in_writing) {
            for score in &screened.new {
                self.delivered.keys.remove(&(report.step, score.seed));
            }
            let mut completed = None;
            let reply = match written {
                Ok(()) => Ok(self.record(&report, screened, &mut completed)),
                // Nothing is counted, so the scores are new again when the evaluator delivers them once more.
                Err(error) => {
                    self.scoreboard.keep(&report, Instant::now());
                    Err(Rejection::NotSaved(error.clone()))
                }
            };
            self.answer(question, keys::scores(&self.run), reply.map(|reply| (reply, report.evaluator)));
            if let Some(notice) = completed {
                self.notices.send(notice).ok();
            }
        }
        self.settle();
    }

    /// Counts scores that are on the disk.
    fn record(&mut self, report: &ScoreReport, screened: Screened, completed: &mut Option<Notice>) -> ScoreReply {
        let Screened { new, duplicates } = screened;
        let recorded = self.scoreboard.record(report, &new);
        let evaluation = &self.metrics.evaluation;
        evaluation.scores_recorded.inc_by(new.len() as u64);
        evaluation.scores_duplicate.inc_by(duplicates.into());
        evaluation.jobs_completed.inc_by(recorded.jobs_completed as u64);
        self.audited(&recorded.audited, &report.precision);
        if let Some(scores) = recorded.evaluation_completed {
            self.show(report.step, &scores);
            *completed = Some(Notice::Evaluated { step: report.step, scores });
        }
        let incarnation = self.scoreboard.incarnation();
        let reply = ScoreReply::Recorded { incarnation, new: new.len() as u32, duplicates };
        if !new.is_empty() {
            self.publish(report, new);
        }
        reply
    }

    /// Writes down which episodes were scored twice, and says which of them differ.
    fn audited(&mut self, audited: &[Audited], precision: &Name) {
        for audited in audited {
            let (seed, names) = (audited.first.0.seed, [&audited.first.1, &audited.second.1]);
            self.metrics.evaluation.audits(audited.agree()).inc();
            if !audited.agree() {
                let [first, second] = [audited.first.0, audited.second.0].map(|score| score.episode_return);
                error!(step = audited.step, seed, %precision, first, second, "{} and {} differ", names[0], names[1]);
                self.notices.send(Notice::ScoresDiffer(names.map(Clone::clone))).ok();
            }
        }
        let lines: Vec<_> = audited.iter().map(|audited| AuditLine::new(audited, precision)).collect();
        if !lines.is_empty() {
            self.scribe.send(Lines::Audits(lines)).ok();
        }
    }

    /// Lets the metrics show a complete evaluation, if it is the newest.
    pub(super) fn show(&self, step: u64, scores: &[EpisodeScore]) {
        let evaluation = &self.metrics.evaluation;
        if let Ok(step) = i64::try_from(step)
            && step >= evaluation.step.get()
        {
            evaluation.score.set(scores.iter().map(|score| score.score).sum::<f64>() / scores.len() as f64);
            evaluation.step.set(step);
        }
    }

    /// Publishes recorded scores for observers. The system works without any, so a failure does not matter.
    fn publish(&self, report: &ScoreReport, episodes: Vec<EpisodeScore>) {
        let Some(herald) = &self.herald else { return };
        let ScoreReport { run, step, weights, evaluator, .. } = report.clone();
        let recorded = RecordedScores { run, step, weights, evaluator, episodes };
        let Ok(bytes) = encode(&recorded) else { return };
        herald.scores(keys::scores_at(&self.run, step), bytes);
    }
}
