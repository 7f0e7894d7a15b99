//! The order of online episodes and gradient steps: how many steps the rows allow, and which
//! snapshot plays the next episodes. All of it is a function of the settings and of the episodes'
//! lengths, so that neither clocks nor the number of evaluators can change a run.

use std::mem;

use quad_protocol::{Exploration, online_seed};
use quad_run::config::Online;

/// An online episode that evaluators may play.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Opening {
    /// Number of the episode, from 0: experience enters the buffer in this order.
    pub episode: u64,
    /// Gradient step of the snapshot that acts.
    pub step: u64,
    pub seed: u64,
    pub exploration: Exploration,
}

/// The schedule after the episodes that training has absorbed.
#[derive(Clone, Debug)]
pub struct OnlineSchedule {
    online: Online,
    /// Gradient steps before the first online.
    begin: u64,
    seed: u64,
    /// Episodes absorbed, and their rows.
    episodes: u64,
    rows: u64,
    /// Episodes that are open and still to be announced.
    openings: Vec<Opening>,
}

impl OnlineSchedule {
    /// The schedule of a run with this seed, before its first episode.
    pub fn new(online: Online, begin: u64, seed: u64) -> Self {
        let lag = u64::from(online.lag);
        let mut schedule = Self { online, begin, seed, episodes: 0, rows: 0, openings: Vec::new() };
        (0..lag).for_each(|episode| schedule.open(episode, begin));
        schedule
    }

    /// Number of the next episode.
    pub fn next_episode(&self) -> u64 {
        self.episodes
    }

    pub fn rows(&self) -> u64 {
        self.rows
    }

    /// True from the first gradient step online on.
    pub fn has_begun(&self, step: u64) -> bool {
        step >= self.begin
    }

    /// The last gradient step that the rows so far allow.
    pub fn due(&self) -> u64 {
        self.begin + self.online.updates_after(self.rows)
    }

    /// True if online episodes may be played with the policy after this gradient step.
    pub fn is_snapshot(&self, step: u64) -> bool {
        self.online.is_snapshot(self.begin, step)
    }

    /// Counts the next episode with its rows.
    pub fn absorb(&mut self, rows: u64) {
        let (number, step) = (self.episodes, self.due());
        self.rows += rows;
        self.episodes += 1;
        if self.rows < self.online.steps {
            self.open(number + u64::from(self.online.lag), step);
        }
    }

    /// Episodes that were opened since the last call and are not absorbed.
    pub fn take_openings(&mut self) -> Vec<Opening> {
        let mut openings = mem::take(&mut self.openings);
        openings.retain(|opening| opening.episode >= self.episodes);
        openings
    }

    /// Opens an episode at this gradient step.
    fn open(&mut self, episode: u64, step: u64) {
        let Online { warmup, uniform_warmup, noise, .. } = self.online;
        let exploration = match uniform_warmup && self.rows < warmup {
            true => Exploration::Uniform,
            false => Exploration::Policy { noise: noise as f32 },
        };
        let step = self.online.newest_snapshot(self.begin, step);
        let seed = online_seed(self.seed, episode);
        self.openings.push(Opening { episode, step, seed, exploration });
    }
}
