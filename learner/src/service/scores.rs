//! The thread `scores`: writes scores down, and only then counts and acknowledges them.
//!
//! All reports that have come while it was at the last ones go together, in one write and one synchronisation. A slow disk
//! delays the acknowledgements, and nothing else.

use std::collections::BTreeSet;
use std::sync::mpsc::{Receiver, RecvTimeoutError};

use quad_protocol::ScoreReport;
use quad_service::Beat;

use super::coordinator::Coordinator;
use super::disk::DiskStatus;
use super::metrics::Metrics;
use super::rejection::Rejection;
use super::requests::Request;
use crate::evaluation::Validated;
use crate::run::{Log, ScoreLine};

/// Most reports that are written together.
const MOST_TOGETHER: usize = 256;

/// An evaluator's report, and the query that it came with; nothing when no more will come that is to be waited for.
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
    /// The thread's work, until it is told that nothing more will come.
    pub fn run(mut self, beat: &Beat) -> anyhow::Result<()> {
        let mut ended = false;
        while !ended {
            beat.alive();
            let first = match self.deliveries.recv_timeout(beat.interval()) {
                Ok(first) => first,
                Err(RecvTimeoutError::Timeout) => continue,
                Err(RecvTimeoutError::Disconnected) => return Ok(()),
            };
            let mut reports = Vec::new();
            for delivery in std::iter::once(first).chain(self.deliveries.try_iter()).take(MOST_TOGETHER) {
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

    /// Handles some reports together. Gives those back that have an episode that another one of them has, too: they are
    /// looked at once the other one is counted.
    fn take_in(&mut self, reports: Vec<(Request, ScoreReport)>, beat: &Beat) -> Vec<(Request, ScoreReport)> {
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
        // What is on the disk already does not wait for it.
        let (new, known): (Vec<_>, Vec<_>) =
            accepted.into_iter().partition(|(_, _, validated)| !validated.new.is_empty());
        self.acknowledge(known);
        self.write(new, beat);
        later
    }

    /// Writes the new scores of reports, and answers each.
    fn write(&mut self, reports: Vec<(Request, ScoreReport, Validated)>, beat: &Beat) {
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

    /// Counts the scores of reports, which are on the disk, and answers each.
    fn acknowledge(&self, reports: Vec<(Request, ScoreReport, Validated)>) {
        let replies = self.coordinator.record(reports.iter().map(|(_, report, validated)| (report, validated)));
        for ((request, ..), reply) in reports.into_iter().zip(replies) {
            request.reply(&reply);
        }
    }

    /// Nothing is counted, so the scores are new again when the evaluators deliver them once more.
    fn refuse(&self, reports: Vec<(Request, ScoreReport, Validated)>, error: &str) {
        for (request, report, _) in reports {
            self.coordinator.keep(&report);
            request.reject(&Rejection::NotSaved(error.to_owned()), &self.metrics);
        }
    }
}
