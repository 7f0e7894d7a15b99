//! Training in small: gradient steps, online episodes, snapshots and checkpoints in the order of
//! the real loop.

use std::collections::BTreeMap;

use quad_learner::service::{OnlineSchedule, Opening};
use quad_protocol::{Episode, Hash};

use crate::arithmetic::{digest, mix, play, snapshot};
use crate::settings::Settings;

/// A training state, as a checkpoint keeps it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct State {
    pub step: u64,
    pub digest: u64,
}

#[derive(Debug)]
pub enum Output {
    Snapshot {
        step: u64,
        weights: Hash,
        evaluate: bool,
    },
    Opening(Opening),
    /// Training waits for this episode.
    Waits(u64),
    Checkpoint(State),
    Ended,
}

/// Result of an attempt to go on.
#[derive(Debug, PartialEq)]
pub enum Progress {
    Stepped,
    /// The next online episode is not there.
    Waits,
    Ended,
}

#[derive(Debug)]
pub struct Training {
    state: State,
    schedule: Option<OnlineSchedule>,
    /// Hash of the absorbed episodes.
    buffer: u64,
    /// Recorded episodes that are not absorbed, by number.
    pub inbox: BTreeMap<u64, Episode>,
    pub outputs: Vec<Output>,
    told_waiting: Option<u64>,
    begun: bool,
}

impl Training {
    /// Training from a checkpoint, or from the beginning.
    pub fn new(
        settings: &Settings,
        checkpoint: Option<State>,
        inbox: BTreeMap<u64, Episode>,
    ) -> Result<Self, String> {
        let online = settings.online.clone();
        let schedule = online.map(|online| OnlineSchedule::new(online, settings.offline_steps, 0));
        let state = checkpoint.unwrap_or(State { step: 0, digest: 0 });
        let mut training = Self {
            state,
            schedule,
            buffer: 0,
            inbox,
            outputs: Vec::new(),
            told_waiting: None,
            begun: false,
        };
        while training
            .schedule
            .as_ref()
            .is_some_and(|online| online.has_begun(state.step) && online.due() < state.step)
        {
            if !training.absorb() {
                return Err("the log lacks an episode that its checkpoint has learned from".into());
            }
        }
        Ok(training)
    }

    pub fn state(&self) -> State {
        self.state
    }

    fn absorb(&mut self) -> bool {
        let Some(schedule) = &mut self.schedule else { return false };
        let Some(episode) = self.inbox.remove(&schedule.next_episode()) else { return false };
        self.buffer = mix(self.buffer, digest(&episode));
        schedule.absorb(episode.rewards.len() as u64);
        true
    }

    /// A gradient step, if one is left and online episodes allow it.
    pub fn go_on(&mut self, settings: &Settings) -> Progress {
        let State { step, .. } = self.state;
        if step >= settings.schedule.steps {
            self.outputs.push(Output::Ended);
            return Progress::Ended;
        }
        if !self.begun {
            self.begun = true;
            if self.is_online_snapshot(step) {
                self.save_policy(settings);
            }
        }
        if !self.go_online(step) {
            return Progress::Waits;
        }
        self.state.step += 1;
        self.state.digest = mix(mix(self.state.digest, self.buffer), self.state.step);
        let step = self.state.step;
        if settings.schedule.is_evaluated(step) || self.is_online_snapshot(step) {
            self.save_policy(settings);
        }
        Progress::Stepped
    }

    /// Absorbs online episodes until they allow a gradient step. False if one is missing.
    fn go_online(&mut self, step: u64) -> bool {
        while let Some(schedule) =
            self.schedule.as_mut().filter(|schedule| schedule.has_begun(step))
        {
            for opening in schedule.take_openings() {
                if !self.inbox.contains_key(&opening.episode) {
                    self.outputs.push(Output::Opening(opening));
                }
            }
            if step != schedule.due() {
                return true;
            }
            let next = schedule.next_episode();
            if !self.absorb() {
                if self.told_waiting.replace(next) != Some(next) {
                    self.outputs.push(Output::Waits(next));
                }
                return false;
            }
        }
        true
    }

    fn is_online_snapshot(&self, step: u64) -> bool {
        self.schedule.as_ref().is_some_and(|schedule| schedule.is_snapshot(step))
    }

    fn save_policy(&mut self, settings: &Settings) {
        let State { step, digest } = self.state;
        let evaluate = settings.schedule.is_evaluated(step);
        self.outputs.push(Output::Snapshot { step, weights: snapshot(step, digest), evaluate });
    }
}

/// Snapshots and last state of a run without any fault.
#[derive(Debug)]
pub struct Reference {
    pub snapshots: BTreeMap<u64, Hash>,
    pub last: State,
}

impl Reference {
    /// Trains with evaluators of kind 0.
    pub fn new(settings: &Settings) -> Self {
        let mut training = Training::new(settings, None, BTreeMap::new()).expect("it is new");
        let mut snapshots = BTreeMap::new();
        loop {
            let progress = training.go_on(settings);
            for output in std::mem::take(&mut training.outputs) {
                match output {
                    Output::Snapshot { step, weights, .. } => drop(snapshots.insert(step, weights)),
                    Output::Opening(Opening { episode, step, seed, exploration }) => {
                        let played = play(settings, (step, snapshots[&step]), seed, exploration, 0);
                        training.inbox.insert(episode, played);
                    }
                    Output::Waits(_) | Output::Checkpoint(_) | Output::Ended => {}
                }
            }
            if progress == Progress::Ended {
                return Self { snapshots, last: training.state() };
            }
        }
    }
}
