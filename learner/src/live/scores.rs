//! The thread `scores`: writes scores and experience to the disk, then counts and acknowledges
//! them.
//!
//! All reports that arrived during the last write go together, in one write and one
//! synchronization. A slow disk delays only acknowledgments.

use std::collections::BTreeSet;
use std::sync::mpsc::{Receiver, RecvTimeoutError};

use quad_protocol::{Piece, ScoreReply, ScoreReport};
use quad_run::folder::{Log, ScoreLine};
use quad_runtime::Heartbeat;

use super::coordinator::Coordinator;
use super::disk::DiskStatus;
use super::experience::{Experience, refuse};
use super::requests::{NotAccepted, Request};
use crate::evaluation::{Refusal, Validated};

/// Most reports that are written together.
const MOST_TOGETHER: usize = 256;

/// An evaluator's message with its query.
pub(super) enum Delivery {
    Scores(Request, ScoreReport),
    Piece(Request, Piece),
    /// Marks the last one to wait for.
    End,
}

pub(super) struct Scores {
    /// `scores.jsonl`.
    pub log: Log,
    pub deliveries: Receiver<Delivery>,
    pub coordinator: Coordinator,
    pub disk: DiskStatus,
    /// In a run with practice.
    pub experience: Option<Experience>,
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
            let mut batch = vec![first];
            batch.extend(self.deliveries.try_iter().take(MOST_TOGETHER - 1));
            let (mut reports, mut pieces) = (Vec::new(), Vec::new());
            for delivery in batch {
                match delivery {
                    Delivery::Scores(request, report) => reports.push((request, report)),
                    Delivery::Piece(request, piece) => pieces.push((request, piece)),
                    Delivery::End => ended = true,
                }
            }
            self.record(reports, beat);
            match &mut self.experience {
                Some(experience) => experience.receive(pieces, &mut self.disk, beat),
                // Evaluators owe them to an earlier run of this name.
                None => pieces.into_iter().for_each(|(request, piece)| {
                    refuse(request, &Refusal::Practice(piece.seed).into(), &self.coordinator);
                }),
            }
        }
        Ok(())
    }

    /// Writes the new scores of reports, and answers each report.
    fn record(&mut self, reports: Vec<(Request, ScoreReport)>, beat: &Heartbeat) {
        // Step and seed of the scores to write: a second score of an episode is a duplicate.
        let mut seen = BTreeSet::new();
        let (mut batch, mut lines) = (Vec::new(), Vec::new());
        for (request, report) in reports {
            let mut validated = match self.coordinator.validate(&report) {
                Ok(validated) => validated,
                Err(refusal) => {
                    self.coordinator.metrics.reject(refusal.label());
                    let incarnation = self.coordinator.incarnation();
                    request.reply(&match refusal {
                        Refusal::NotYet => ScoreReply::NotYet { incarnation },
                        _ => ScoreReply::Refused { incarnation, reason: refusal.to_string() },
                    });
                    continue;
                }
            };
            if validated.new.is_empty() {
                // All of its scores are on the disk.
                self.acknowledge(request, &report, &validated);
                continue;
            }
            let count = validated.new.len();
            validated.new.retain(|score| seen.insert((report.step, score.seed)));
            validated.duplicates += (count - validated.new.len()) as u32;
            lines.extend(validated.new.iter().map(|score| ScoreLine::new(&report, score)));
            batch.push((request, report, validated));
        }
        if lines.is_empty() {
            return;
        }
        match self.log.append(&lines) {
            Ok(()) => {
                self.disk.accepted(beat);
                for (request, report, validated) in batch {
                    self.acknowledge(request, &report, &validated);
                }
            }
            // The scores are still new when the evaluators deliver them again.
            Err(error) => {
                let error = format!("{:#}", anyhow::Error::from(error));
                self.disk.refused(beat, &error);
                for (request, ..) in batch {
                    let why = NotAccepted::NotSaved(error.clone());
                    request.reject(&why, &self.coordinator.metrics);
                }
            }
        }
    }

    fn acknowledge(&self, request: Request, report: &ScoreReport, validated: &Validated) {
        request.reply(&self.coordinator.record(report, validated));
    }
}
