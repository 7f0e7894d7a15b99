//! Deliveries: score reports, and online episodes in pieces. They wait for the disk, are checked,
//! written together, and then acknowledged.

use std::collections::BTreeSet;
use std::mem;

use quad_protocol::{CodecError, Episode, Piece, ScoreReport};
use quad_run::folder::ScoreLine;

use super::Service;
use super::message::{Answer, Count, Frame, Order};
use super::queue::Deliveries;

/// Most deliveries of a kind that are written together.
const MOST_TOGETHER: usize = 256;

impl<Q> Service<Q> {
    /// True if a flush would do something.
    pub fn has_deliveries(&self) -> bool {
        let Deliveries { reports, pieces, .. } = &self.deliveries;
        let waits = !reports.is_empty() || !pieces.is_empty();
        waits && !self.deliveries.is_busy()
    }

    /// Without an answer the evaluator tries again.
    pub(super) fn report_arrived(&mut self, query: Q, report: ScoreReport) {
        match self.deliveries.is_full() {
            true => self.orders.push(Order::Count(Count::Rejected("busy"))),
            false => self.deliveries.reports.push_back((query, report)),
        }
    }

    /// Without an answer the evaluator tries again.
    pub(super) fn piece_arrived(&mut self, query: Q, piece: Piece) {
        match self.deliveries.is_full() {
            true => self.orders.push(Order::Count(Count::Rejected("busy"))),
            false => self.deliveries.pieces.push_back((query, piece)),
        }
    }

    /// Checks what has arrived during the last write, and writes it together.
    pub(super) fn flush(&mut self) {
        if self.deliveries.is_busy() {
            return;
        }
        for _ in 0..MOST_TOGETHER {
            let Some((query, report)) = self.deliveries.reports.pop_front() else { break };
            self.check_report(query, report);
        }
        for _ in 0..MOST_TOGETHER {
            let Some((query, piece)) = self.deliveries.pieces.pop_front() else { break };
            self.add_piece(query, &piece);
        }
        self.append();
    }

    /// Checks a decoded episode. After the last one everything is written.
    pub(super) fn decoded(&mut self, frame: Frame<Q>, episode: Result<Box<Episode>, CodecError>) {
        self.deliveries.decoding -= 1;
        self.check_episode(frame, episode);
        self.append();
    }

    /// Orders the write of all that is checked, unless more is still decoded.
    fn append(&mut self) {
        let is_busy = self.deliveries.is_busy();
        let Deliveries { writing_scores, writing_episodes, .. } = &mut self.deliveries;
        if is_busy || (writing_scores.is_empty() && writing_episodes.is_empty()) {
            return;
        }
        // Step and seed of the scores to write: a second score of an episode is a duplicate.
        let (mut scores, mut seen) = (Vec::new(), BTreeSet::new());
        for (_, report, new) in writing_scores {
            new.retain(|score| seen.insert((report.step, score.seed)));
            scores.extend(new.iter().map(|score| ScoreLine::new(report, score)));
        }
        let frames = writing_episodes.iter().map(|(frame, _)| frame.bytes.clone()).collect();
        self.deliveries.appending = true;
        self.orders.push(Order::Append { scores, frames });
    }

    /// Counts and acknowledges what the disk has taken. The rest is new when it is delivered again.
    pub(super) fn appended(&mut self, [scores, experience]: [Result<(), String>; 2]) {
        self.deliveries.appending = false;
        for (query, report, new) in mem::take(&mut self.deliveries.writing_scores) {
            match &scores {
                Ok(()) => self.acknowledge(query, &report, &new),
                Err(error) => self.not_saved(query, error),
            }
        }
        for (frame, episode) in mem::take(&mut self.deliveries.writing_episodes) {
            match &experience {
                Ok(()) => self.recorded(frame, episode),
                Err(error) => self.not_recorded(frame, error),
            }
        }
    }

    pub(super) fn not_saved(&mut self, query: Q, error: &str) {
        self.try_again(query, "not_saved", format!("it could not be saved, try again: {error}"));
    }

    pub(super) fn try_again(&mut self, query: Q, label: &'static str, reason: String) {
        let reply = Order::Reply(query, Answer::TryAgain(reason));
        self.orders.extend([Order::Count(Count::Rejected(label)), reply]);
    }
}
