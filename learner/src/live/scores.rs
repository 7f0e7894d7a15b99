//! The thread `scores`: writes scores to the disk, then counts and acknowledges them.
//!
//! All reports that arrived during the last write go together, in one write and one
//! synchronization. A slow disk delays only acknowledgments.

use std::collections::BTreeSet;
use std::sync::mpsc::{Receiver, RecvTimeoutError};

use quad_protocol::ScoreReport;
use quad_run::folder::{Log, ScoreLine};
use quad_runtime::Heartbeat;

use super::coordinator::Coordinator;
use super::disk::DiskStatus;
use super::metrics::Metrics;
use super::requests::{NotAccepted, Request};
use crate::evaluation::Validated;

/// Most reports that are written together.
const MOST_TOGETHER: usize = 256;

/// An evaluator's report with its query; `None` marks the last one to wait for.
pub(super) type Delivery = Option<(Request, ScoreReport)>;

/// State of the thread.
pub(super) struct Scores {
    /// `scores.jsonl`.
    pub log: Log,
    pub deliveries: Receiver<Delivery>,
    pub coordinator: Coordinator,
    pub metrics: Metrics,
    pub disk: DiskStatus,
}

impl Scores {
    /// The thread's work, until the last report.
    pub fn run(mut self, beat: &Heartbeat) -> anyhow::Result<()> {
        let mut ended = false;
        while !ended {
            beat.alive();
            let first = match self.deliveries.recv_timeout(beat.interval()) {
                Ok(first) => first,
                Err(RecvTimeoutError::Timeout) => continue,
                Err(RecvTimeoutError::Disconnected) => return Ok(()),
            };
            let mut reports = Vec::new();
            for delivery in
                std::iter::once(first).chain(self.deliveries.try_iter()).take(MOST_TOGETHER)
            {
                match delivery {
                    Some(report) => reports.push(report),
                    None => ended = true,
                }
            }
            while !reports.is_empty() {
                reports = self.take_in(reports, beat);
            }
        }
        Ok(())
    }

    /// Handles reports together. If two of them contain the same episode, returns the second for
    /// the next round, when the first is counted.
    fn take_in(
        &mut self,
        reports: Vec<(Request, ScoreReport)>,
        beat: &Heartbeat,
    ) -> Vec<(Request, ScoreReport)> {
        let mut seen = BTreeSet::new();
        let (now, later): (Vec<_>, Vec<_>) = reports.into_iter().partition(|(_, report)| {
            let keys = || report.episodes.iter().map(|score| (report.step, score.seed));
            let first = !keys().any(|key| seen.contains(&key));
            seen.extend(keys().filter(|_| first));
            first
        });
        let mut accepted = Vec::new();
        let validated = self.coordinator.validate(now.iter().map(|(_, report)| report));
        for ((request, report), validated) in now.into_iter().zip(validated) {
            match validated {
                Ok(validated) => accepted.push((request, report, validated)),
                Err(refusal) => {
                    self.metrics.reject(refusal.label());
                    request.reply(&self.coordinator.refused(refusal));
                }
            }
        }
        // Scores that are already on the disk need not wait for it.
        let (new, known): (Vec<_>, Vec<_>) =
            accepted.into_iter().partition(|(_, _, validated)| !validated.new.is_empty());
        self.acknowledge(known);
        self.write(new, beat);
        later
    }

    /// Writes the new scores of reports, and answers each report.
    fn write(&mut self, reports: Vec<(Request, ScoreReport, Validated)>, beat: &Heartbeat) {
        let of = |(_, report, validated): &(_, ScoreReport, Validated)| {
            validated.new.iter().map(|score| ScoreLine::new(report, score)).collect::<Vec<_>>()
        };
        let lines: Vec<_> = reports.iter().flat_map(of).collect();
        if lines.is_empty() {
            return;
        }
        if let Err(error) = self.log.append(&lines) {
            let error = format!("{:#}", anyhow::Error::from(error));
            self.disk.refused(beat, &error);
            return self.refuse(reports, &error);
        }
        self.disk.well(beat);
        self.acknowledge(reports);
    }

    /// Counts the scores of reports, which are on the disk, and answers each report.
    fn acknowledge(&self, reports: Vec<(Request, ScoreReport, Validated)>) {
        let replies = self
            .coordinator
            .record(reports.iter().map(|(_, report, validated)| (report, validated)));
        for ((request, ..), reply) in reports.into_iter().zip(replies) {
            request.reply(&reply);
        }
    }

    /// Counts no score, so the scores are still new when the evaluators deliver them again.
    fn refuse(&self, reports: Vec<(Request, ScoreReport, Validated)>, error: &str) {
        for (request, report, _) in reports {
            self.coordinator.keep(&report);
            request.reject(&NotAccepted::NotSaved(error.to_owned()), &self.metrics);
        }
    }
}
