//! Deliveries: score reports, and online episodes in pieces. They wait for the disk, are checked,
//! written together, and then acknowledged.

use std::collections::BTreeSet;

use quad_protocol::{CodecError, Episode, Hash, Piece, PieceReply, ScoreReply, ScoreReport};
use quad_run::folder::ScoreLine;

use super::message::{Answer, Count, End, Frame, Order, TryAgain};
use super::outcomes::OnlineEpisodeState;
use super::pieces::Added;
use super::queue::{Arrival, Writing};
use super::refusal::Refusal;
use super::service::Service;
use super::validate::Validated;

/// Most deliveries that wait for the disk; the senders of more try again.
const MOST_WAITING: usize = 1024;
/// Most deliveries that are written together.
const MOST_TOGETHER: usize = 256;

impl<Q> Service<Q> {
    /// True if a flush would do something.
    pub fn has_deliveries(&self) -> bool {
        !self.deliveries.arrived.is_empty() && !self.is_busy()
    }

    fn is_busy(&self) -> bool {
        self.deliveries.decoding > 0 || self.deliveries.appending
    }

    pub(super) fn scores(&mut self, query: Q, report: ScoreReport) {
        self.arrive(Arrival::Scores(query, report));
    }

    pub(super) fn piece(&mut self, query: Q, piece: Piece) {
        self.arrive(Arrival::Piece(query, piece));
    }

    /// Queues a delivery. Without an answer its evaluator tries again.
    fn arrive(&mut self, arrival: Arrival<Q>) {
        match self.deliveries.arrived.len() < MOST_WAITING {
            true => self.deliveries.arrived.push_back(arrival),
            false => self.orders.push(Order::Count(Count::Rejected("busy"))),
        }
    }

    /// Checks what has arrived during the last write, and writes it together.
    pub(super) fn flush(&mut self) {
        if self.is_busy() {
            return;
        }
        for _ in 0..MOST_TOGETHER {
            match self.deliveries.arrived.pop_front() {
                Some(Arrival::Scores(query, report)) => self.report(query, report),
                Some(Arrival::Piece(query, piece)) => self.add_piece(query, &piece),
                None => break,
            }
        }
        self.append();
    }

    fn report(&mut self, query: Q, report: ScoreReport) {
        match self.board.validate(&report) {
            // All of its scores are on the disk.
            Ok(validated) if validated.new.is_empty() => {
                self.acknowledge(query, &report, &validated)
            }
            Ok(validated) => {
                self.deliveries.writing.push(Writing::Scores(query, report, validated));
            }
            Err(refusal) => {
                let incarnation = self.rules.incarnation;
                let reply = Answer::Scores(match refusal {
                    Refusal::NotYet => ScoreReply::NotYet { incarnation },
                    _ => ScoreReply::Refused { incarnation, reason: refusal.to_string() },
                });
                self.orders.extend([Order::rejected(refusal), Order::Reply(query, reply)]);
            }
        }
    }

    fn add_piece(&mut self, query: Q, piece: &Piece) {
        let incarnation = self.rules.incarnation;
        let Piece { seed, hash, .. } = *piece;
        let number = match self.board.online(piece) {
            Ok(OnlineEpisodeState::Open { episode }) => episode,
            Ok(OnlineEpisodeState::NotYet) => return self.try_again(query, TryAgain::NotYet),
            Ok(OnlineEpisodeState::Recorded(recorded)) => {
                if hash != recorded {
                    self.orders.push(Order::Count(Count::Difference));
                }
                let reply = PieceReply::Recorded { incarnation, duplicate: true };
                return self.orders.push(Order::Reply(query, Answer::Piece(reply)));
            }
            Err(refusal) => {
                return self.refuse_episode(query, refusal.label(), &refusal.to_string());
            }
        };
        match self.deliveries.pieces.add(piece) {
            Added::Continue(offset) => {
                let reply = PieceReply::Continue { incarnation, offset };
                self.orders.push(Order::Reply(query, Answer::Piece(reply)));
            }
            Added::Whole(bytes) => {
                self.deliveries.decoding += 1;
                self.orders.push(Order::Decode(Frame { query, seed, number, hash, bytes }));
            }
        }
    }

    /// Checks a decoded episode. After the last one everything is written.
    pub(super) fn decoded(&mut self, frame: Frame<Q>, episode: Result<Box<Episode>, CodecError>) {
        self.deliveries.decoding -= 1;
        match episode {
            Err(error) => self.drop_frame(frame, error.label(), &error.to_string()),
            Ok(episode) => match self.board.validate_online(frame.number, &episode) {
                Err(refusal) => self.drop_frame(frame, refusal.label(), &refusal.to_string()),
                Ok(()) => self.deliveries.writing.push(Writing::Episode(frame, episode)),
            },
        }
        self.append();
    }

    fn drop_frame(&mut self, frame: Frame<Q>, label: &'static str, reason: &str) {
        self.deliveries.pieces.remove(frame.seed);
        self.refuse_episode(frame.query, label, reason);
    }

    /// Tells an evaluator that its episode will never be accepted.
    fn refuse_episode(&mut self, query: Q, label: &'static str, reason: &str) {
        let (incarnation, reason) = (self.rules.incarnation, reason.to_owned());
        let reply = Answer::Piece(PieceReply::Refused { incarnation, reason });
        self.orders.extend([Order::Count(Count::Rejected(label)), Order::Reply(query, reply)]);
    }

    fn try_again(&mut self, query: Q, why: TryAgain) {
        self.orders.push(Order::Count(Count::Rejected(why.label())));
        self.orders.push(Order::Reply(query, Answer::TryAgain(why)));
    }

    /// Orders the write of all that is checked, unless more is still decoded.
    fn append(&mut self) {
        if self.is_busy() || self.deliveries.writing.is_empty() {
            return;
        }
        // Step and seed of the scores to write: a second score of an episode is a duplicate.
        let mut seen = BTreeSet::new();
        let (mut scores, mut frames) = (Vec::new(), Vec::new());
        for writing in &mut self.deliveries.writing {
            match writing {
                Writing::Scores(_, report, Validated { new, duplicates }) => {
                    let count = new.len();
                    new.retain(|score| seen.insert((report.step, score.seed)));
                    *duplicates += (count - new.len()) as u32;
                    scores.extend(new.iter().map(|score| ScoreLine::new(report, score)));
                }
                Writing::Episode(frame, _) => frames.push(frame.bytes.clone()),
            }
        }
        self.deliveries.appending = true;
        self.orders.push(Order::Append { scores, frames });
    }

    /// Counts and acknowledges what the disk has taken. The rest is new when it is delivered again.
    pub(super) fn appended(&mut self, [scores, experience]: [Result<(), String>; 2]) {
        self.deliveries.appending = false;
        for writing in std::mem::take(&mut self.deliveries.writing) {
            match writing {
                Writing::Scores(query, report, validated) => match &scores {
                    Ok(()) => self.acknowledge(query, &report, &validated),
                    Err(error) => self.try_again(query, TryAgain::NotSaved(error.clone())),
                },
                Writing::Episode(frame, episode) => match &experience {
                    Ok(()) => self.recorded(frame, episode),
                    Err(error) => {
                        self.deliveries.pieces.give_back(frame.seed, frame.bytes);
                        self.try_again(frame.query, TryAgain::NotSaved(error.clone()));
                    }
                },
            }
        }
    }

    fn recorded(&mut self, frame: Frame<Q>, episode: Box<Episode>) {
        let Frame { query, seed, number, hash, .. } = frame;
        self.deliveries.pieces.remove(seed);
        let jobs = self.board.record_experience(seed, hash);
        let incarnation = self.rules.incarnation;
        let reply = PieceReply::Recorded { incarnation, duplicate: false };
        self.orders.extend([
            Order::Learn { number, episode },
            Order::Count(Count::Jobs("completed", jobs)),
            Order::Reply(query, Answer::Piece(reply)),
        ]);
    }

    /// Counts scores that are on the disk.
    fn acknowledge(&mut self, query: Q, report: &ScoreReport, validated: &Validated) {
        let Validated { new, duplicates } = validated;
        let recorded = self.board.record(report, new);
        self.orders.push(Order::Count(Count::Scores { new: new.len(), duplicates: *duplicates }));
        self.orders.push(Order::Count(Count::Jobs("completed", recorded.jobs_completed)));
        if let Some(scores) = recorded.evaluation_completed {
            self.orders.push(Order::Evaluated { step: report.step, scores, earlier: false });
        }
        let (incarnation, new) = (self.rules.incarnation, new.len() as u32);
        let reply = ScoreReply::Recorded { incarnation, new, duplicates: *duplicates };
        self.orders.push(Order::Reply(query, Answer::Scores(reply)));
    }

    /// Opens the evaluation of a snapshot.
    pub(super) fn snapshot(&mut self, step: u64, weights: Hash) {
        match self.board.open(step, weights) {
            Ok(Some(scores)) => {
                self.orders.push(Order::Evaluated { step, scores, earlier: true });
            }
            Ok(None) => {}
            Err(error) => self.orders.push(Order::End(End::OtherWeights(error))),
        }
    }
}
