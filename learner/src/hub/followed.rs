//! Whose liveliness tokens the learner follows behind a router: those of evaluators that ask for work, each until it leaves.
//!
//! To follow all of a run's tokens would mean to receive those of every stranger: a router passes on whatever fits, and Zenoh
//! reads it, however much it is. So a token is only followed when its owner has asked, and a router limits how often one asks.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use quad_protocol::Name;

use super::evaluators::MOST_EVALUATORS;
use super::rejection::Rejection;

/// In the long run, one more is followed this often; all that may be there can come at once.
const INTERVAL: Duration = Duration::from_millis(100);
/// A token that is not there so long after its owner asked is not waited for. It is followed when its owner asks again.
const PATIENCE: Duration = Duration::from_secs(10);

/// To the thread that declares it on Zenoh, which can take seconds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Follow {
    /// From now on, say when this evaluator joins and leaves; and whether it is there already.
    Begin(Name),
    /// No longer.
    End(Name),
}

/// Who is followed, and since when.
pub(super) struct Followed {
    follower: Sender<Follow>,
    since: BTreeMap<Name, Instant>,
    /// When all that were begun would have been, one in each interval.
    due: Instant,
}

impl Followed {
    /// Nobody yet.
    pub fn new(follower: Sender<Follow>) -> Self {
        Self { follower, since: BTreeMap::new(), due: Instant::now() }
    }

    /// An evaluator asked for work: follows it.
    ///
    /// # Errors
    ///
    /// There are too many, or too many have come in a short time. It may work all the same; that it leaves is then known by
    /// its lease alone.
    pub fn asked(&mut self, evaluator: &Name, now: Instant) -> Result<(), Rejection> {
        if self.since.contains_key(evaluator) {
            return Ok(());
        }
        let due = self.due.max(now) + INTERVAL;
        if self.since.len() >= MOST_EVALUATORS || due > now + INTERVAL * MOST_EVALUATORS as u32 {
            return Err(Rejection::Crowd);
        }
        self.due = due;
        self.since.insert(evaluator.clone(), now);
        // The thread ends when the process does.
        self.follower.send(Follow::Begin(evaluator.clone())).ok();
        Ok(())
    }

    /// Whether what is told of this evaluator is what was asked for.
    pub fn includes(&self, evaluator: &Name) -> bool {
        self.since.contains_key(evaluator)
    }

    /// It has left. Whoever only comes and goes is not followed in it.
    pub fn left(&mut self, evaluator: &Name) {
        if self.since.remove(evaluator).is_some() {
            self.follower.send(Follow::End(evaluator.clone())).ok();
        }
    }

    /// Gives up those that never came.
    pub fn tick(&mut self, now: Instant, present: &BTreeSet<Name>) {
        let follower = &self.follower;
        self.since.retain(|evaluator, since| {
            let keep = present.contains(evaluator) || now.duration_since(*since) < PATIENCE;
            if !keep {
                follower.send(Follow::End(evaluator.clone())).ok();
            }
            keep
        });
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
        for _ in 0..3 {
            followed.asked(&name(1), now).unwrap();
        }
        followed.tick(now + 2 * PATIENCE, &[name(1)].into());
        assert!(followed.includes(&name(1)));
        followed.left(&name(1));
        followed.left(&name(1));
        assert!(!followed.includes(&name(1)));
        followed.asked(&name(1), now).unwrap();
        let expected = [Follow::Begin(name(1)), Follow::End(name(1)), Follow::Begin(name(1))];
        assert_eq!(told.try_iter().collect::<Vec<_>>(), expected);
    }

    #[test]
    fn made_up_names_are_forgotten_and_their_number_is_bounded() {
        let (mut followed, told) = followed();
        let start = Instant::now();
        let flood = |followed: &mut Followed, names: std::ops::Range<usize>, now| {
            names.filter(|&number| followed.asked(&name(number), now).is_ok()).count()
        };
        assert_eq!(flood(&mut followed, 0..5000, start), MOST_EVALUATORS);
        let later = start + PATIENCE;
        followed.tick(later, &[name(7)].into());
        assert_eq!(followed.since.keys().collect::<Vec<_>>(), [&name(7)]);
        let mut begun = told.try_iter().filter(|told| matches!(told, Follow::Begin(_))).count();
        assert_eq!(begun, MOST_EVALUATORS);
        // After so many at once, few.
        begun = flood(&mut followed, 5000..10_000, later);
        assert_eq!(begun as u128, PATIENCE.as_millis() / INTERVAL.as_millis());
        assert!(followed.asked(&name(7), later).is_ok(), "who is there is not in their way");
    }
}
