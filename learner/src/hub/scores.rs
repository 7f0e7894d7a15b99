//! What becomes of a report: its scores are written down, counted, shown and published.

use anyhow::anyhow;
use quad_protocol::{EpisodeScore, Name, RecordedScores, ScoreReply, ScoreReport, encode, keys};
use tracing::{debug, error};
use zenoh::Wait;
use zenoh::qos::CongestionControl;

use super::Hub;
use super::rejection::Rejection;
use crate::notice::Notice;
use crate::run_dir::{AuditLine, ScoreLine};
use crate::scoreboard::Audited;

impl Hub {
    /// Checks the scores, writes the new ones to disk, counts them. Only then does the caller acknowledge the report.
    pub(super) fn report(
        &mut self,
        report: &ScoreReport,
        completed: &mut Option<Notice>,
    ) -> Result<ScoreReply, Rejection> {
        let incarnation = self.scoreboard.incarnation();
        let screened = match report.cannot_act {
            Some(_) => self.scoreboard.screen_complaint(report).map(|()| None),
            None => self.scoreboard.screen(report).map(Some),
        };
        let screened = match screened {
            Ok(Some(screened)) => screened,
            Ok(None) => {
                let reason = report.cannot_act.as_ref().map(|complaint| complaint.reason.as_str()).unwrap_or_default();
                let (step, evaluator) = (report.step, &report.evaluator);
                let broken = anyhow!("the policy of step {step} cannot act: {reason} (evaluator {evaluator})");
                self.notices.send(Notice::Failed(broken)).ok();
                return Ok(ScoreReply::Recorded { incarnation, new: 0, duplicates: 0 });
            }
            Err(refusal) => {
                self.reject(&Rejection::Refused(refusal));
                return Ok(ScoreReply::Refused { incarnation, reason: refusal.to_string() });
            }
        };
        if !screened.new.is_empty() {
            let lines: Vec<_> = screened.new.iter().map(|score| ScoreLine::new(report, score)).collect();
            // If this fails nothing is counted, so the scores are new again when the evaluator delivers them once more.
            self.logs.scores.append(&lines)?;
        }
        let recorded = self.scoreboard.record(report, &screened.new);
        let evaluation = &self.metrics.evaluation;
        evaluation.scores_recorded.inc_by(screened.new.len() as u64);
        evaluation.scores_duplicate.inc_by(screened.duplicates.into());
        evaluation.jobs_completed.inc_by(recorded.jobs_completed as u64);
        self.audited(&recorded.audited, &report.precision);
        if let Some(scores) = recorded.evaluation_completed {
            self.show(report.step, &scores);
            *completed = Some(Notice::Evaluated { step: report.step, scores });
        }
        let (new, duplicates) = (screened.new.len() as u32, screened.duplicates);
        let reply = ScoreReply::Recorded { incarnation, new, duplicates };
        if !screened.new.is_empty() {
            self.publish(report, screened.new);
        }
        Ok(reply)
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
        if let Some(log) = self.logs.audits.as_mut().filter(|_| !lines.is_empty())
            && let Err(error) = log.append(&lines)
        {
            error!(%error, "the audits could not be saved");
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
        let Some(session) = &self.session else { return };
        let ScoreReport { run, step, weights, evaluator, .. } = report.clone();
        let recorded = RecordedScores { run, step, weights, evaluator, episodes };
        let Ok(bytes) = encode(&recorded) else { return };
        let put = session.put(keys::scores_at(&self.run, report.step), bytes);
        if let Err(error) = put.congestion_control(CongestionControl::Drop).wait() {
            debug!(%error, "recorded scores could not be published");
        }
    }
}
