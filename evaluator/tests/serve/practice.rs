//! Episodes of practice, which go to the learner in pieces until it has saved them.

use quad_protocol::{Episode, Exploration, Hash, Job, Piece, PieceReply, decode};

use super::learner::{Behavior, Evaluator, Event, Learner, State, file_for, job};

impl State {
    /// Takes a piece. Returns the answer, if the learner gives one.
    pub fn take(&mut self, piece: Piece) -> Option<PieceReply> {
        let incarnation = self.incarnation;
        let frame = self.frames.entry(piece.seed).or_default();
        let duplicate = frame.len() == piece.length as usize;
        if frame.len() == piece.offset as usize {
            frame.extend(piece.bytes);
        }
        if self.behavior == Behavior::Forgets && frame.len() > 2 * Piece::MOST {
            self.behavior = Behavior::Records;
            frame.clear();
        }
        let whole = frame.len() == piece.length as usize;
        assert!(!whole || Hash::of(frame) == piece.hash);
        let (offset, reason) = (frame.len() as u32, "its rewards are too good".to_owned());
        match self.behavior {
            Behavior::Silent => None,
            _ if !whole => Some(PieceReply::Continue { incarnation, offset }),
            Behavior::Refuses => Some(PieceReply::Refused { incarnation, reason }),
            Behavior::LosesAnswer => {
                self.behavior = Behavior::Records;
                None
            }
            _ => {
                self.job = None;
                Some(PieceReply::Recorded { incarnation, duplicate })
            }
        }
    }
}

/// A learner that gives out practice in HalfCheetah, whose episodes have a thousand steps, with an
/// evaluator.
async fn start(behavior: Behavior) -> (Learner, Evaluator, impl Sized) {
    let learner = Learner::start(file_for("halfcheetah", (17, 6)), behavior).await;
    let practice = Some(Exploration::Policy { noise: 0.0 });
    let environment = "halfcheetah".to_owned();
    learner.give(Job { environment, practice, ..job(&learner.snapshot) });
    let (evaluator, token) = learner.evaluator().await;
    (learner, evaluator, token)
}

fn pieces(events: &[Event]) -> Vec<Piece> {
    let piece = |event: &Event| match event {
        Event::Piece(piece) => Some(piece.clone()),
        _ => None,
    };
    events.iter().filter_map(piece).collect()
}

/// Waits until the learner has all episodes and is asked for more, and returns their pieces.
async fn all_pieces(learner: &Learner) -> Vec<Piece> {
    let has_all = |events: &[Event]| {
        let claims = matches!(events.last(), Some(Event::Claim(_)));
        (claims && learner.lock().frames.len() == 3).then(|| events.to_vec())
    };
    let events = learner.wait_for(has_all).await;
    for (seed, frame) in &learner.lock().frames {
        let episode: Episode = decode(frame).unwrap();
        assert_eq!((episode.weights, episode.score.seed), (learner.snapshot.hash, *seed));
        assert_eq!((episode.dims(), episode.score.length), ((17, 6), 1000));
    }
    // Nothing is claimed or handed back meanwhile.
    let first = events.iter().position(Event::is_piece).unwrap();
    let last = events.iter().rposition(Event::is_piece).unwrap();
    assert!(events[first..last].iter().all(Event::is_piece), "{events:?}");
    assert!(!events.iter().any(Event::is_handed_back), "{events:?}");
    pieces(&events)
}

#[tokio::test(flavor = "multi_thread")]
async fn episodes_come_in_pieces_from_where_the_learner_wants_them() {
    let (learner, _evaluator, _token) = start(Behavior::Forgets).await;
    let sent = all_pieces(&learner).await;
    let places = sent.iter().map(|piece| (piece.seed, piece.offset as usize / Piece::MOST));
    let expected = [(11, 0..3), (11, 0..4), (12, 0..4), (13, 0..4)];
    let expected = expected.into_iter().flat_map(|(seed, places)| places.map(move |i| (seed, i)));
    assert!(places.eq(expected));
}

#[tokio::test(flavor = "multi_thread")]
async fn episodes_are_sent_until_they_are_saved_even_to_another_process() {
    for behavior in [Behavior::LosesAnswer, Behavior::DiskFull, Behavior::Silent] {
        let (learner, _evaluator, token) = start(behavior).await;
        learner.wait_for(|events| pieces(events).get(1).cloned()).await;
        let _token = match behavior {
            Behavior::Silent => {
                drop(token);
                learner.lock().incarnation = 8;
                Ok(learner.announce(8).await)
            }
            _ => Err(token),
        };
        if behavior != Behavior::LosesAnswer {
            learner.behave(Behavior::Records);
        }
        let sent = all_pieces(&learner).await;
        let again = sent.iter().zip(&sent[1..]).filter(|(one, next)| one == next).count();
        assert!(again > 0 && sent.len() == 12 + again);
        assert!(sent.iter().all(|piece| (piece.incarnation, piece.job) == (7, 1)));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_with_a_refused_episode_is_handed_back() {
    let (learner, _evaluator, _token) = start(Behavior::Refuses).await;
    let reason = learner.wait_for_hand_back().await.unwrap();
    assert_eq!(reason, "it refused the episode with seed 11: its rewards are too good");
    // Nothing is sent again.
    assert_eq!(pieces(&learner.events()).len(), 4);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_leaving_evaluator_hands_back_what_is_not_acknowledged() {
    for behavior in [Behavior::DiskFull, Behavior::Silent] {
        let (learner, evaluator, _token) = start(behavior).await;
        learner.wait_for(|events| pieces(events).first().cloned()).await;
        assert!(evaluator.leave().success());
        assert_eq!(learner.wait_for_hand_back().await, None);
        assert!(pieces(&learner.events()).len() > 1, "they are sent again");
    }
}
