//! An online episode, which goes to the learner in pieces until it has saved it.

use quad_protocol::{Episode, Exploration, Hash, Job, Piece, PieceReply, decode};
use tokio::task::spawn_blocking;

use super::learner::{Behavior, Evaluator, Event, Learner, State, file_for, in_order, job};

impl State {
    /// Takes a piece. Returns the answer, if the learner gives one.
    pub fn take(&mut self, piece: Piece) -> Option<PieceReply> {
        let (incarnation, length) = (self.incarnation, piece.length as usize);
        if self.frame.len() == piece.offset as usize {
            self.frame.extend(piece.bytes);
        }
        let whole = self.frame.len() == length;
        assert!(!whole || Hash::new(&self.frame) == piece.hash);
        let (offset, reason) = (self.frame.len() as u32, "its rewards are too good".to_owned());
        match self.behavior {
            Behavior::Silent => None,
            _ if !whole => Some(PieceReply::Continue { incarnation, offset }),
            Behavior::Refuses => Some(PieceReply::Refused { incarnation, reason }),
            _ => {
                self.job = None;
                Some(PieceReply::Recorded { incarnation, duplicate: false })
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

#[tokio::test(flavor = "multi_thread")]
async fn a_job_with_a_refused_episode_is_handed_back() {
    let (learner, _evaluator, _token) = start(Behavior::Refuses).await;
    let reason = learner.wait_for_hand_back().await.unwrap();
    assert_eq!(reason, "it refused the episode with seed 11: its rewards are too good");
    // Nothing is sent again.
    assert_eq!(pieces(&learner.events()).len(), 4);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_leaving_evaluator_delivers_its_episode() {
    in_order(async || {
        let (learner, evaluator, _token) = start(Behavior::Silent).await;
        learner.wait_for(|events| pieces(events).first().cloned()).await;
        let left = spawn_blocking(move || evaluator.leave());
        learner.behave(Behavior::Records);
        if !left.await.unwrap() {
            return false;
        }
        let episode: Episode = decode(&learner.lock().frame).unwrap();
        assert_eq!((episode.weights, episode.score.seed), (learner.snapshot.hash, 11));
        assert_eq!((episode.dims(), episode.score.length), ((17, 6), 1000));
        assert_eq!((learner.count(Event::is_handed_back), learner.lock().job.clone()), (0, None));
        true
    })
    .await;
}
