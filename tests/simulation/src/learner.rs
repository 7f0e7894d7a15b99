//! A learner's process: the service, the threads around it, and its death and return.

use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;

use quad_dataset::Task;
use quad_learner::service::{Answer, Count, Input, Order, Rules, Service};
use quad_protocol::JobReply;
use rand::Rng;

use crate::arithmetic::ACTION_DIM;
use crate::disk::Experience;
use crate::training::{Output, Progress, State, Training};
use crate::world::{Event, Query, Reply, Sender, World, name};

/// Pause after the disk has refused a write.
const RETRY: Duration = Duration::from_secs(2);
const TICK: Duration = Duration::from_millis(500);

#[derive(Default)]
pub struct LearnerProcess {
    /// `None` while the process is dead.
    pub alive: Option<Alive>,
    /// Number of starts.
    pub epoch: u32,
    /// The incarnation, by a clock that may jump.
    pub incarnation: u64,
}

pub struct Alive {
    pub service: Service<Sender>,
    training: Training,
    /// True if training waits for an online episode.
    waits: bool,
    outputs: VecDeque<Output>,
    writing: bool,
    results: VecDeque<Order<Sender>>,
    appending: bool,
    /// Seeds of the online episodes that are on the disk.
    pub recorded: BTreeSet<u64>,
    /// Steps whose evaluations are complete.
    pub evaluated: BTreeSet<u64>,
    pub last_job: u64,
}

impl World {
    fn rules(&self) -> Rules {
        Rules {
            run: name("run"),
            incarnation: self.learner.incarnation,
            task: Task::new("robot", self.settings.observation_dim, ACTION_DIM),
            seed: 0,
            dims: (self.settings.observation_dim, ACTION_DIM),
            episodes: self.settings.episodes,
            schedule: self.settings.schedule,
            job_episodes: self.settings.job_episodes,
            lease: self.settings.lease,
        }
    }

    /// Starts the learner from its folder.
    pub fn start_learner(&mut self) -> Result<(), String> {
        // A clock that jumps back makes a smaller number than before.
        self.learner.incarnation = self.rng.random_range(1..1_000_000);
        self.learner.epoch += 1;
        let epoch = self.learner.epoch;
        let Experience { recorded, seeds } = self.disk.online(&self.settings)?;
        let service = Service::new(self.rules(), self.disk.saved_scores(), &seeds, self.instant());
        let training = Training::new(&self.settings, self.disk.checkpoint, recorded)?;
        self.learner.alive = Some(Alive {
            service,
            training,
            waits: false,
            outputs: VecDeque::new(),
            writing: false,
            results: VecDeque::new(),
            appending: false,
            recorded: seeds.iter().filter_map(|(seed, frame)| frame.map(|_| *seed)).collect(),
            evaluated: BTreeSet::new(),
            last_job: 0,
        });
        let schedule = self.settings.schedule;
        for (step, weights) in self.disk.snapshots.clone() {
            if schedule.is_evaluated(step) {
                self.carry(Input::Snapshot { step, weights })?;
            }
        }
        self.publish();
        for evaluator in 0..self.evaluators.len() {
            self.announce_evaluator(evaluator);
        }
        self.after(self.settings.gradient_step, Event::Train(epoch));
        self.after(TICK, Event::Tick(epoch));
        Ok(())
    }

    /// Kills the learner. A write that was at work may be done, in part, or not.
    pub fn crash_learner(&mut self) {
        let Some(mut alive) = self.learner.alive.take() else { return };
        if let Some(Order::Append { scores, frames }) = alive.results.pop_front()
            && alive.appending
        {
            let written = self.rng.random_range(0..=scores.len());
            let frames_written = self.rng.random_range(0..=frames.len());
            drop(self.disk.append(&scores[..written], &frames[..frames_written]));
        }
        self.lose_snapshot();
        self.publish();
    }

    /// Loses the newest snapshot, at times, as if it had not been synchronized. Training, which goes
    /// on from an earlier step, makes it again; until then its scores come too early.
    fn lose_snapshot(&mut self) {
        let checkpoint = self.disk.checkpoint.map_or(0, |state| state.step);
        let before = checkpoint.max(self.settings.offline_steps);
        let newest = self.disk.snapshots.last_entry().filter(|newest| *newest.key() > before);
        if let Some(newest) = newest
            && self.rng.random_bool(0.5)
        {
            newest.remove();
        }
    }

    /// A query of an evaluator, or of a stranger, arrives.
    pub fn query(&mut self, from: Sender, query: Query) -> Result<(), String> {
        let Some(alive) = &self.learner.alive else { return Ok(()) };
        match query {
            Query::Job(request) => self.carry(Input::Job(from, request)),
            Query::Scores(report) => self.carry(Input::Scores(from, report)),
            Query::Piece(piece) => self.carry(Input::Piece(from, piece)),
            Query::Weights(step) => {
                let weights = alive.service.weights(step);
                let on_disk = self.disk.snapshots.get(&step);
                if let Some(hash) = weights.filter(|hash| on_disk == Some(hash)) {
                    self.answer(from, Reply::Weights(step, hash));
                }
                Ok(())
            }
        }
    }

    /// Gives the service something, and does what it orders.
    pub fn carry(&mut self, input: Input<Sender>) -> Result<(), String> {
        if !matches!(input, Input::Tick { .. } | Input::Flush) {
            self.record(|| format!("learner: {input:?}"));
        }
        let now = self.instant();
        let Some(alive) = &mut self.learner.alive else { return Ok(()) };
        let orders = alive.service.handle(input, now);
        for order in orders {
            self.carry_out(order)?;
        }
        self.flush()
    }

    fn carry_out(&mut self, order: Order<Sender>) -> Result<(), String> {
        if !matches!(order, Order::Count(_) | Order::Show(_)) {
            self.record(|| format!("learner orders {order:?}"));
        }
        match order {
            Order::Reply(to, answer) => {
                if let Answer::Job(JobReply::Job(job)) = &answer {
                    self.check_job(job)?;
                }
                self.answer(to, Reply::Service(answer));
            }
            Order::Decode(_) | Order::Append { .. } => {
                if let Some(alive) = &mut self.learner.alive {
                    alive.results.push_back(order);
                }
            }
            Order::Learn { number, episode } => {
                let Some(alive) = &mut self.learner.alive else { return Ok(()) };
                let is_new = alive.recorded.insert(episode.score.seed);
                if !is_new || alive.recorded.len() > self.disk.experience.len() {
                    return Err(format!("training gets episode {number} twice, or too early"));
                }
                alive.training.inbox.insert(number, *episode);
                if std::mem::take(&mut alive.waits) {
                    self.after(Duration::ZERO, Event::Train(self.learner.epoch));
                }
            }
            Order::End(end) => self.ended = Some(end),
            Order::Evaluated { step, scores, .. } => {
                let alive = self.learner.alive.as_mut();
                if alive.is_some_and(|alive| !alive.evaluated.insert(step)) {
                    return Err(format!("the evaluation of step {step} is complete twice"));
                }
                for score in scores {
                    let on_disk = self.disk.score(step, score.seed);
                    if on_disk != Some(score) {
                        return Err(format!(
                            "{score:?} of step {step} counts; on disk: {on_disk:?}"
                        ));
                    }
                }
            }
            Order::Count(Count::Jobs("expired", _))
                if self.settings.faults.until.is_zero() && !self.deserted =>
            {
                return Err("a job ended although nothing fails".to_owned());
            }
            Order::Tell(_)
            | Order::Advise
            | Order::Show(_)
            | Order::Forget(_)
            | Order::Count(_) => {}
        }
        Ok(())
    }

    /// Lets the thread that writes results work, if it is idle.
    fn flush(&mut self) -> Result<(), String> {
        let epoch = self.learner.epoch;
        let Some(alive) = &mut self.learner.alive else { return Ok(()) };
        if alive.appending {
            return Ok(());
        }
        match alive.results.front() {
            Some(Order::Append { .. }) => {
                alive.appending = true;
                let took = Duration::from_micros(self.rng.random_range(100..100_000));
                self.after(took, Event::Appended(epoch));
                Ok(())
            }
            Some(_) => {
                let Some(Order::Decode(frame)) = alive.results.pop_front() else { return Ok(()) };
                let episode = frame.decode();
                self.carry(Input::Decoded(frame, episode))
            }
            None if alive.service.has_deliveries() => self.carry(Input::Flush),
            None => Ok(()),
        }
    }

    pub fn appended(&mut self, epoch: u32) -> Result<(), String> {
        let Some(alive) = self.learner.alive.as_mut().filter(|_| epoch == self.learner.epoch)
        else {
            return Ok(());
        };
        alive.appending = false;
        let Some(Order::Append { scores, frames }) = alive.results.pop_front() else {
            return Err("a write ended that was not ordered".to_owned());
        };
        let results = self.disk.append(&scores, &frames);
        self.carry(Input::Appended(results))
    }

    pub fn train(&mut self, epoch: u32) -> Result<(), String> {
        let checkpoint = self.rng.random_bool(0.1);
        let Some(alive) = self.learner.alive.as_mut().filter(|_| epoch == self.learner.epoch)
        else {
            return Ok(());
        };
        let progress = alive.training.go_on(&self.settings);
        alive.outputs.extend(alive.training.outputs.drain(..));
        let state = alive.training.state();
        match progress {
            Progress::Waits => alive.waits = true,
            Progress::Ended => {}
            Progress::Stepped => {
                if checkpoint || state.step == self.settings.schedule.steps {
                    alive.outputs.push_back(Output::Checkpoint(state));
                }
                self.after(self.settings.gradient_step, Event::Train(epoch));
            }
        }
        self.write_output();
        Ok(())
    }

    /// Lets the thread that writes training's output work, if it is idle.
    fn write_output(&mut self) {
        let epoch = self.learner.epoch;
        let took = Duration::from_micros(self.rng.random_range(100..50_000));
        let Some(alive) = &mut self.learner.alive else { return };
        if !alive.writing && !alive.outputs.is_empty() {
            alive.writing = true;
            self.after(took, Event::Written(epoch));
        }
    }

    pub fn written(&mut self, epoch: u32) -> Result<(), String> {
        let Some(alive) = self.learner.alive.as_mut().filter(|_| epoch == self.learner.epoch)
        else {
            return Ok(());
        };
        let writes =
            matches!(alive.outputs.front(), Some(Output::Snapshot { .. } | Output::Checkpoint(_)));
        if writes && self.disk.fails {
            self.after(RETRY, Event::Written(epoch));
            return Ok(());
        }
        alive.writing = false;
        let output = alive.outputs.pop_front();
        match output {
            Some(Output::Snapshot { step, weights, evaluate }) => {
                let before = self.disk.snapshots.insert(step, weights);
                if before.is_some_and(|before| before != weights) {
                    return Err(format!("step {step} was trained again to other weights"));
                }
                self.check_snapshot(step, weights)?;
                if evaluate {
                    self.carry(Input::Snapshot { step, weights })?;
                }
                self.publish();
            }
            Some(Output::Opening(opening)) => {
                let weights = self.disk.snapshots.get(&opening.step).copied();
                let weights = weights.ok_or("an episode is opened without its snapshot")?;
                self.carry(Input::Opened(opening, weights))?;
            }
            Some(Output::Waits(episode)) => self.carry(Input::Waits(episode))?,
            Some(Output::Checkpoint(state)) => self.disk.checkpoint = Some(state),
            Some(Output::Ended) => {
                self.trained = true;
                self.carry(Input::Trained)?;
            }
            None => {}
        }
        self.write_output();
        Ok(())
    }

    pub fn tick(&mut self, epoch: u32) -> Result<(), String> {
        let Some(alive) = self.learner.alive.as_ref().filter(|_| epoch == self.learner.epoch)
        else {
            return Ok(());
        };
        let training_waits = alive.waits;
        self.after(TICK, Event::Tick(epoch));
        self.carry(Input::Tick { training_waits })
    }

    /// The state of training, once the run has ended.
    pub fn last_state(&self) -> Option<State> {
        self.learner.alive.as_ref().map(|alive| alive.training.state())
    }
}
