//! Online episodes, from their opening until training learns from them. They arrive in pieces, of
//! one evaluator or of several.

use std::sync::Arc;

use quad_protocol::{CodecError, Episode, Hash, Piece, PieceReply};

use super::evaluation::{Evaluation, Key};
use super::message::{Answer, Count, Frame, Order, Refusal, require};
use super::online_episode::{OnlineEpisode, Partial};
use super::scores::SCORE_TOLERANCE;
use super::{Opening, Service};

impl<Q> Service<Q> {
    pub(super) fn open_online(&mut self, opening: &Opening, weights: Hash) {
        let open = OnlineEpisode::Open(opening.episode, Partial::default());
        self.online.insert(opening.seed, open);
        let key = Key::Online(opening.episode);
        self.evaluations.insert(key, Evaluation::online(opening, weights));
    }

    /// Adds a piece to its episode. A whole frame is to be decoded.
    pub(super) fn add_piece(&mut self, query: Q, piece: &Piece) {
        let Piece { seed, hash, .. } = *piece;
        let incarnation = self.rules.incarnation;
        let fits = piece.length as usize <= self.rules.longest_frame();
        let check = require(piece.run == self.rules.run, Refusal::Run)
            .and_then(|()| require(fits, Refusal::Rows(seed)))
            .and_then(|()| self.online.get_mut(&seed).ok_or(Refusal::Online(seed)));
        let reply = match check {
            Ok(OnlineEpisode::Open(number, partial)) => match partial.add(piece) {
                Ok(bytes) => {
                    let frame = Frame { query, seed, number: *number, hash, bytes };
                    self.deliveries.decoding += 1;
                    return self.orders.push(Order::Decode(frame));
                }
                Err(offset) => PieceReply::Continue { incarnation, offset },
            },
            Ok(OnlineEpisode::Expected) => {
                let reason = "training has not come to the episode again since the learner's start, try again";
                return self.try_again(query, "not_open_yet", reason.to_owned());
            }
            Ok(OnlineEpisode::Recorded(recorded)) => {
                if hash != *recorded {
                    self.orders.push(Order::Count(Count::Difference));
                }
                PieceReply::Recorded { incarnation, duplicate: true }
            }
            Err(refusal) => {
                return self.refuse_episode(query, refusal.label(), &refusal.to_string());
            }
        };
        self.orders.push(Order::Reply(query, Answer::Piece(reply)));
    }

    /// Checks a decoded episode, which is to be written.
    pub(super) fn check_episode(
        &mut self,
        frame: Frame<Q>,
        episode: Result<Box<Episode>, CodecError>,
    ) {
        let (label, reason) = match episode {
            Ok(episode) => match self.require_fits(frame.number, &episode) {
                Ok(()) => return self.deliveries.writing_episodes.push((frame, episode)),
                Err(refusal) => (refusal.label(), refusal.to_string()),
            },
            Err(error) => (error.label(), error.to_string()),
        };
        if let Some(OnlineEpisode::Open(_, partial)) = self.online.get_mut(&frame.seed) {
            *partial = Partial::default();
        }
        self.refuse_episode(frame.query, label, &reason);
    }

    /// Checks the online episode with this number against its opening.
    fn require_fits(&self, number: u64, episode: &Episode) -> Result<(), Refusal> {
        let seed = episode.score.seed;
        let open = self.evaluations.get(&Key::Online(number));
        let open = open.filter(|open| open.is_scored(seed).is_some());
        let open = open.ok_or(Refusal::Online(seed))?;
        require(open.step == episode.step, Refusal::Step)?;
        require(open.weights == episode.weights, Refusal::Weights)?;
        require(episode.dims() == self.rules.dims, Refusal::Rows(seed))?;
        let sum: f64 = episode.rewards.iter().copied().map(f64::from).sum();
        let size: f64 = episode.rewards.iter().map(|reward| f64::from(reward.abs())).sum();
        let is_sum = (sum - episode.score.episode_return).abs() <= SCORE_TOLERANCE * size.max(1.0);
        require(is_sum && self.is_possible(&episode.score), Refusal::Episode(seed))
    }

    /// Tells an evaluator that its episode will never be accepted.
    fn refuse_episode(&mut self, query: Q, label: &'static str, reason: &str) {
        let (incarnation, reason) = (self.rules.incarnation, reason.to_owned());
        let reply = Answer::Piece(PieceReply::Refused { incarnation, reason });
        self.orders.extend([Order::Count(Count::Rejected(label)), Order::Reply(query, reply)]);
    }

    /// Takes a frame back that could not be written: its last piece completes it again.
    pub(super) fn not_recorded(&mut self, frame: Frame<Q>, error: &str) {
        if let Some(OnlineEpisode::Open(_, partial)) = self.online.get_mut(&frame.seed) {
            (partial.bytes, partial.given_out) = (Arc::unwrap_or_clone(frame.bytes), false);
        }
        self.not_saved(frame.query, error);
    }

    /// Gives training an episode that is on the disk. Its jobs end.
    pub(super) fn recorded(&mut self, frame: Frame<Q>, episode: Box<Episode>) {
        let Frame { query, seed, number, hash, .. } = frame;
        self.online.insert(seed, OnlineEpisode::Recorded(hash));
        let (key, open_jobs) = (Key::Online(number), self.jobs.len());
        self.evaluations.remove(&key);
        self.jobs.retain(|_, open| open.key != key);
        self.orders.push(Order::Learn { number, episode });
        self.count_jobs("completed", open_jobs - self.jobs.len());
        let incarnation = self.rules.incarnation;
        let reply = PieceReply::Recorded { incarnation, duplicate: false };
        self.orders.push(Order::Reply(query, Answer::Piece(reply)));
    }
}
