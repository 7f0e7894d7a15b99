//! An online episode, which goes to the learner in pieces until it has saved it.

use quad_protocol::{Episode, Exploration, Hash, Job, Piece, PieceReply, decode};
use tokio::task::spawn_blocking;

use super::learner::{Behavior, Evaluator, Event, Learner, State, file_for, job};

impl State {
    /// Takes a piece. Returns the answer, if the learner gives one.
    pub fn take(&mut self, piece: Piece) -> Option<PieceReply> {
        let (incarnation, length) = (self.incarnation, piece.length as usize);
        let duplicate = self.frame.len() == length;
        if self.frame.len() == piece.offset as usize {
            self.frame.extend(piece.bytes);
        }
        if self.behavior == Behavior::Forgets && self.frame.len() > 2 * Piece::MOST {
            self.behavior = Behavior::Records;
            self.frame.clear();
        }
        let whole = self.frame.len() == length;
        assert!(!whole || Hash::new(&self.frame) == piece.hash);
        let (offset, reason) = (self.frame.len() as u32, "its rewards are too good".to_owned());
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

/// A learner that gives out online episodes in HalfCheetah, an episode of a thousand steps, with an
/// evaluator.
async fn start(behavior: Behavior) -> (Learner, Evaluator, impl Sized) {
    let learner = Learner::start(file_for("halfcheetah", (17, 6)), behavior).await;
    let exploration = Some(Exploration::Policy { noise: 0.0 });
    let environment = "halfcheetah".to_owned();
    learner.give(Job { environment, exploration, seeds: vec![11], ..job(&learner.snapshot) });
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

/// Waits until the learner has the episode and is asked for more, and returns all pieces.
async fn all_pieces(learner: &Learner) -> Vec<Piece> {
    let has_all = |events: &[Event]| {
        let claims = matches!(events.last(), Some(Event::Claim(_)));
        (claims && learner.lock().job.is_none()).then(|| events.to_vec())
    };
    let events = learner.wait_for(has_all).await;
    let episode: Episode = decode(&learner.lock().frame).unwrap();
    assert_eq!((episode.weights, episode.score.seed), (learner.snapshot.hash, 11));
    assert_eq!((episode.dims(), episode.score.length), ((17, 6), 1000));
    // Nothing is claimed or handed back meanwhile.
    let first = events.iter().position(Event::is_piece).unwrap();
    let last = events.iter().rposition(Event::is_piece).unwrap();
    assert!(events[first..last].iter().all(Event::is_piece), "{events:?}");
    assert!(!events.iter().any(Event::is_handed_back), "{events:?}");
    pieces(&events)
}

#[tokio::test(flavor = "multi_thread")]
async fn an_episode_comes_in_pieces_from_where_the_learner_wants_them_until_it_is_saved() {
    for (behavior, expected) in
        [(Behavior::Forgets, &[0, 1, 2, 0, 1, 2, 3][..]), (Behavior::LosesAnswer, &[0, 1, 2, 3, 3])]
    {
        let (learner, _evaluator, _token) = start(behavior).await;
        let sent = all_pieces(&learner).await;
        let places = sent.iter().map(|piece| piece.offset as usize / Piece::MOST);
        assert_eq!(Vec::from_iter(places), expected);
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
async fn a_leaving_evaluator_sends_its_episode_again_and_hands_the_job_back_in_the_end() {
    for answers in [true, false] {
        let (learner, evaluator, _token) = start(Behavior::Silent).await;
        learner.wait_for(|events| pieces(events).first().cloned()).await;
        let left = spawn_blocking(move || evaluator.leave());
        learner.wait_for(|events| pieces(events).get(1).cloned()).await;
        if answers {
            learner.behave(Behavior::Records);
        }
        assert!(left.await.unwrap().success());
        if answers {
            assert_eq!(
                (learner.count(Event::is_handed_back), learner.lock().job.clone()),
                (0, None)
            );
        } else {
            assert_eq!(learner.wait_for_hand_back().await, None);
        }
    }
}
