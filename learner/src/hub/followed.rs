//! Whose liveliness tokens the learner follows: those of evaluators that ask for work, each until it leaves.
//!
//! To follow all of a run's tokens would mean to receive those of every stranger: a router passes on whatever fits, and Zenoh
//! reads it, however much it is. So a token is only followed when its owner has asked, and a router limits how often one asks.
//! That one has left can be missed in a flood, so whoever says nothing for long is looked for again.

use std::collections::BTreeMap;
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use quad_protocol::Name;

use super::evaluators::MOST_EVALUATORS;
use super::rejection::Rejection;

/// In the long run, one more is followed this often; all that may be there can come at once.
const INTERVAL: Duration = Duration::from_millis(100);
/// A token that is not there so long after it was looked for is not waited for. It is followed when its owner asks again.
const PATIENCE: Duration = Duration::from_secs(10);
/// An evaluator without work asks for it every minute, one that has a job tells its progress more often. One that is at the
/// job of another run says nothing.
const SILENCE: Duration = Duration::from_secs(150);

/// To the thread that declares it on Zenoh, which can take seconds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Follow {
    /// From now on, say when this evaluator joins and leaves; and whether it is there already.
    Begin(Name),
    /// No longer.
    End(Name),
}

/// Who is followed.
pub(super) struct Followed {
    follower: Sender<Follow>,
    tokens: BTreeMap<Name, Token>,
    /// When all that were begun would have been, one in each interval.
    due: Instant,
}

/// What is known of one's token.
#[derive(Clone, Copy, Debug)]
enum Token {
    /// It is looked for since then.
    Wanted(Instant),
    /// It was there when its owner was last heard of, then.
    There(Instant),
    /// The same, but since then it is looked for again.
    Doubted(Instant),
}

impl Followed {
    /// Nobody yet.
    pub fn new(follower: Sender<Follow>) -> Self {
        Self { follower, tokens: BTreeMap::new(), due: Instant::now() }
    }

    /// An evaluator asked for work: follows it.
    ///
    /// # Errors
    ///
    /// There are too many, or too many have come in a short time. It may work all the same; that it leaves is then known by
    /// its lease alone.
    pub fn asked(&mut self, evaluator: &Name, now: Instant) -> Result<(), Rejection> {
        if self.tokens.contains_key(evaluator) {
            self.heard(evaluator, now);
            return Ok(());
        }
        let due = self.due.max(now) + INTERVAL;
        if self.tokens.len() >= MOST_EVALUATORS || due > now + INTERVAL * MOST_EVALUATORS as u32 {
            return Err(Rejection::Crowd);
        }
        self.due = due;
        self.tokens.insert(evaluator.clone(), Token::Wanted(now));
        self.tell(Follow::Begin(evaluator.clone()));
        Ok(())
    }

    /// An evaluator says something, so it is there.
    pub fn heard(&mut self, evaluator: &Name, now: Instant) {
        if let Some(Token::There(since)) = self.tokens.get_mut(evaluator) {
            *since = now;
        }
    }

    /// Its token is there. False if that was told while it was no longer wanted.
    pub fn joined(&mut self, evaluator: &Name, now: Instant) -> bool {
        let token = self.tokens.get_mut(evaluator);
        token.map(|token| *token = Token::There(now)).is_some()
    }

    /// It has left. Whoever only comes and goes is not followed in it.
    pub fn left(&mut self, evaluator: &Name) {
        if self.tokens.remove(evaluator).is_some() {
            self.tell(Follow::End(evaluator.clone()));
        }
    }

    /// Looks again for those that say nothing, and gives up those that never came. Gives those that must have left.
    pub fn tick(&mut self, now: Instant) -> Vec<Name> {
        let (mut never_came, mut gone, mut silent) = (Vec::new(), Vec::new(), Vec::new());
        for (evaluator, token) in &mut self.tokens {
            match *token {
                Token::Wanted(since) if now - since >= PATIENCE => never_came.push(evaluator.clone()),
                Token::Doubted(since) if now - since >= PATIENCE => gone.push(evaluator.clone()),
                Token::There(since) if now - since >= SILENCE => {
                    *token = Token::Doubted(now);
                    silent.push(evaluator.clone());
                }
                _ => {}
            }
        }
        never_came.iter().for_each(|evaluator| self.left(evaluator));
        silent.into_iter().for_each(|evaluator| self.tell(Follow::Begin(evaluator)));
        gone
    }

    fn tell(&self, what: Follow) {
        // The thread ends when the process does.
        self.follower.send(what).ok();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, channel};

    use super::*;

    fn name(number: usize) -> Name {
        Name::new(format!("e-{number}")).unwrap()
    }

    fn followed() -> (Followed, Receiver<Follow>) {
        let (follower, told) = channel();
        (Followed::new(follower), told)
    }

    #[test]
    fn an_evaluator_is_followed_once_until_it_leaves() {
        let (mut followed, told) = followed();
        let now = Instant::now();
        assert!(!followed.joined(&name(1), now));
        for _ in 0..3 {
            followed.asked(&name(1), now).unwrap();
        }
        assert!(followed.joined(&name(1), now));
        assert_eq!(followed.tick(now + 2 * PATIENCE), []);
        followed.left(&name(1));
        followed.left(&name(1));
        assert!(!followed.joined(&name(1), now));
        followed.asked(&name(1), now).unwrap();
        let expected = [Follow::Begin(name(1)), Follow::End(name(1)), Follow::Begin(name(1))];
        assert_eq!(told.try_iter().collect::<Vec<_>>(), expected);
    }

    #[test]
    fn whoever_says_nothing_is_looked_for_and_is_gone_if_it_is_not_found() {
        let (mut followed, told) = followed();
        let start = Instant::now();
        for number in 1..=4 {
            followed.asked(&name(number), start).unwrap();
            followed.joined(&name(number), start);
        }
        let later = start + SILENCE;
        followed.asked(&name(1), later).unwrap();
        followed.heard(&name(2), later);
        told.try_iter().for_each(drop);
        assert_eq!(followed.tick(later), []);
        assert_eq!(told.try_iter().collect::<Vec<_>>(), [3, 4].map(|number| Follow::Begin(name(number))));
        assert!(followed.joined(&name(3), later), "it is found");
        assert_eq!(followed.tick(later + PATIENCE), [name(4)]);
        followed.left(&name(4));
        assert_eq!(told.try_iter().collect::<Vec<_>>(), [Follow::End(name(4))]);
        assert_eq!(followed.tick(later + PATIENCE), []);
    }

    #[test]
    fn made_up_names_are_forgotten_and_their_number_is_bounded() {
        let (mut followed, told) = followed();
        let start = Instant::now();
        let flood = |followed: &mut Followed, names: std::ops::Range<usize>, now| {
            names.filter(|&number| followed.asked(&name(number), now).is_ok()).count()
        };
        assert_eq!(flood(&mut followed, 0..5000, start), MOST_EVALUATORS);
        followed.joined(&name(7), start);
        let later = start + PATIENCE;
        followed.tick(later);
        assert_eq!(followed.tokens.keys().collect::<Vec<_>>(), [&name(7)]);
        let mut begun = told.try_iter().filter(|told| matches!(told, Follow::Begin(_))).count();
        assert_eq!(begun, MOST_EVALUATORS);
        // After so many at once, few.
        begun = flood(&mut followed, 5000..10_000, later);
        assert_eq!(begun as u128, PATIENCE.as_millis() / INTERVAL.as_millis());
        assert!(followed.asked(&name(7), later).is_ok(), "who is there is not in their way");
    }
}
