//! The network: messages that are late, lost or doubled, and who sees whom.

use std::time::Duration;

use rand::Rng;

use crate::world::{Event, Reply, Sender, World};

/// Time after which a side notices that the other is gone.
const NOTICED: Duration = Duration::from_secs(5);

impl World {
    /// Sends a message between the learner and an evaluator: late, lost, or twice.
    pub fn send(&mut self, event: Event, evaluator: Option<usize>) {
        if evaluator.is_some_and(|number| self.evaluators[number].cut) {
            return;
        }
        let faults = &self.settings.faults;
        let (lost, doubled, delay) = match self.now < faults.until {
            true => (faults.lost, faults.doubled, faults.delay),
            false => (0.0, 0.0, Duration::from_millis(5)),
        };
        if self.rng.random_bool(lost) {
            return;
        }
        if self.rng.random_bool(doubled) {
            let late = delay.mul_f64(self.rng.random());
            self.after(late, event.clone());
        }
        let late = delay.mul_f64(self.rng.random());
        self.after(late, event);
    }

    /// Sends the learner's answer.
    pub fn answer(&mut self, to: Sender, reply: Reply) {
        if to != Sender::STRANGER {
            self.send(Event::Answer(to, Box::new(reply)), Some(to.evaluator));
        }
    }

    /// Tells evaluators that there may be work, or no learner.
    pub fn publish(&mut self) {
        for number in 0..self.evaluators.len() {
            self.tell_evaluator_of_learner(number);
        }
    }

    /// Shows an evaluator which learners are there.
    pub fn tell_evaluator_of_learner(&mut self, number: usize) {
        let evaluator = &self.evaluators[number];
        let pause = match self.learner.alive.is_some() && !evaluator.cut {
            true => Duration::from_millis(self.rng.random_range(1..100)),
            false => NOTICED.mul_f64(self.rng.random()),
        };
        self.after(pause, Event::Learners(number, self.evaluators[number].epoch));
    }

    /// Shows the learner whether an evaluator is there.
    pub fn announce_evaluator(&mut self, number: usize) {
        let pause = Duration::from_millis(self.rng.random_range(1..100));
        self.after(pause, Event::Token(number));
    }

    /// Cuts an evaluator off from the learner, or ends that.
    pub fn cut(&mut self, number: usize, cut: bool) {
        self.record(|| format!("e{number} is cut off: {cut}"));
        self.evaluators[number].cut = cut;
        let pause = if cut { NOTICED.mul_f64(self.rng.random()) } else { Duration::ZERO };
        self.after(pause, Event::Token(number));
        self.tell_evaluator_of_learner(number);
    }
}
