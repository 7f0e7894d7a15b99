//! The thread `scores`: writes scores down, and only then counts and acknowledges them.
//!
//! All reports that have come while it was at the last ones go together, in one write and one synchronisation. A slow disk
//! delays the acknowledgements, and nothing else.

use std::collections::BTreeSet;
use std::sync::mpsc::{Receiver, RecvTimeoutError};

use quad_protocol::{ScoreReply, ScoreReport};
use quad_service::{Beat, stay_in_background};

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
        stay_in_background();
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
        let (mut new, mut later, mut seen) = (Vec::new(), Vec::new(), BTreeSet::new());
        for (request, report) in reports {
            let keys = || report.episodes.iter().map(|score| (report.step, score.seed));
            if keys().any(|key| seen.contains(&key)) {
                later.push((request, report));
                continue;
            }
            match self.coordinator.validate(&report) {
                Err(refusal) => {
                    self.metrics.reject(refusal.label());
                    request.reply(&self.coordinator.refused(refusal));
                }
                Ok(validated) if validated.new.is_empty() => {
                    request.reply(&self.coordinator.record(&report, &validated));
                }
                Ok(validated) => {
                    seen.extend(keys());
                    new.push((request, report, validated));
                }
            }
        }
        self.write(new, beat);
        later
    }

    /// Writes the new scores of reports, and answers each.
    fn write(&mut self, new: Vec<(Request, ScoreReport, Validated)>, beat: &Beat) {
        if new.is_empty() {
            return;
        }
        let of = |(_, report, validated): &(_, ScoreReport, Validated)| {
            validated.new.iter().map(|score| ScoreLine::new(report, score)).collect::<Vec<_>>()
        };
        let lines: Vec<_> = new.iter().flat_map(of).collect();
        let written = self.log.append(&lines).map_err(|error| format!("{:#}", anyhow::Error::from(error)));
        match &written {
            Ok(()) => self.disk.well(beat),
            Err(error) => self.disk.refused(beat, error),
        }
        for (request, report, validated) in new {
            match &written {
                Ok(()) => request.reply::<ScoreReply>(&self.coordinator.record(&report, &validated)),
                // Nothing is counted, so the scores are new again when the evaluator delivers them once more.
                Err(error) => {
                    self.coordinator.keep(&report);
                    request.reject(&Rejection::NotSaved(error.clone()), &self.metrics);
                }
            }
        }
    }
}
