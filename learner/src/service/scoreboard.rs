//! All evaluations of a run.

use std::collections::{BTreeMap, HashMap};
use std::ops::RangeBounds;
use std::sync::Arc;
use std::time::{Duration, Instant};

use quad_dataset::Task;
use quad_protocol::{
    Episode, EpisodeScore, Hash, Job, Message, Name, Progress, ScoreReport, episode_seeds,
};
use quad_run::config::Schedule;
use quad_run::folder::SavedScores;

use super::episodes::{Evaluation, Key};
use super::open_job::OpenJob;
use super::outcomes::{Claim, Claimed, Lost, OnlineEpisodeState, Opening, OtherWeights, Recorded};
use super::refusal::{Refusal, require};

/// Time after which an evaluator without a job asks again: the larger of this time, and the second
/// one for each evaluator, so that hundreds of idle ones do not keep the learner busy. A new
/// snapshot wakes them all.
const ASK_AGAIN: [Duration; 2] = [Duration::from_millis(500), Duration::from_millis(100)];
/// [`ASK_AGAIN`] while there are online episodes to play, for which training may wait.
const ASK_FOR_ONLINE: [Duration; 2] = [Duration::from_millis(20); 2];
/// [`ASK_AGAIN`] between two online episodes: training comes to the next one when it has
/// learned from another, which may be short.
const ASK_BETWEEN: [Duration; 2] = [Duration::from_millis(100), Duration::from_millis(20)];
/// Time between an evaluator's progress messages, by the rule of [`ASK_AGAIN`].
const PROGRESS: [Duration; 2] = [Duration::from_secs(1), Duration::from_millis(40)];
/// Longest time between progress messages.
const LONGEST_PROGRESS: Duration = Duration::from_secs(20);
/// Time after which an evaluator without the run's environment asks again.
const DOES_NOT_FIT: Duration = Duration::from_secs(10);

/// An online episode for which training has waited for this time goes to a second evaluator: the
/// first answer counts.
const STRAGGLER: Duration = Duration::from_secs(20);

/// Constants of all evaluations of a run.
#[derive(Clone, Debug)]
pub struct Rules {
    pub run: Name,
    /// Number of this start of the learner.
    pub incarnation: u64,
    pub task: Task,
    /// Seed of the run: of its episodes, and of what the environment draws once for the whole run.
    pub seed: u64,
    /// Sizes of an observation and of an action.
    pub dims: (usize, usize),
    /// Episodes per evaluation.
    pub episodes: u32,
    pub schedule: Schedule,
    /// Most episodes in one job: while as many evaluators as there are could share them, and if
    /// many more wait.
    pub job_episodes: [usize; 2],
    /// Longest time of a job without progress. It is longer if there are so many evaluators that
    /// they report progress rarely.
    pub lease: Duration,
}

impl Rules {
    /// Most bytes of an online episode's frame.
    pub fn longest_frame(&self) -> usize {
        let steps = self.task.max_episode_steps().unwrap_or(Episode::LONGEST).min(Episode::LONGEST);
        let numbers = self.dims.0 + self.dims.1 + 2;
        ((steps + 1) * numbers * size_of::<f32>() + (1 << 10)).min(Episode::LIMIT)
    }
}

#[derive(Debug)]
pub(crate) struct Scoreboard {
    pub(super) rules: Arc<Rules>,
    pub(super) evaluations: BTreeMap<Key, Evaluation>,
    jobs: BTreeMap<Name, OpenJob>,
    next_job: u64,
    /// Scores of an earlier incarnation, by step, whose evaluation is not open yet.
    earlier: BTreeMap<u64, SavedScores>,
    /// Online episodes by seed.
    pub(super) online: HashMap<u64, OnlineEpisodeState>,
    /// Number of the online episode that training waits for, and since when.
    awaited: Option<(u64, Instant)>,
    online_ended: bool,
}

impl Scoreboard {
    /// A scoreboard without evaluations. The scores of an `earlier` incarnation count as soon as
    /// the evaluation of their step is added.
    pub fn new(rules: Arc<Rules>, earlier: BTreeMap<u64, SavedScores>) -> Self {
        Self {
            rules,
            evaluations: BTreeMap::new(),
            jobs: BTreeMap::new(),
            next_job: 1,
            earlier,
            online: HashMap::new(),
            awaited: None,
            online_ended: false,
        }
    }

    /// Adds an evaluation of the snapshot of `step`, unless there is one. Returns the scores if an
    /// earlier incarnation has completed it.
    ///
    /// # Errors
    /// The step is known with other weights.
    pub fn add_evaluation(
        &mut self,
        step: u64,
        weights: Hash,
        seeds: &[u64],
    ) -> Result<Option<Vec<EpisodeScore>>, OtherWeights> {
        let known = self.evaluations.get(&Key::Evaluation(step));
        let known = known.map(|evaluation| evaluation.weights.to_string());
        let is_known = known.is_some();
        let earlier = || self.earlier.get(&step).map(|earlier| earlier.weights.clone());
        if let Some(scored) = known.or_else(earlier).filter(|scored| *scored != weights.to_string())
        {
            return Err(OtherWeights { step, found: weights, scored });
        }
        if is_known {
            return Ok(None);
        }
        let scores = self.earlier.remove(&step).map(|earlier| earlier.episodes).unwrap_or_default();
        let evaluation = Evaluation::new(step, weights, seeds, &scores);
        let complete = evaluation.scores();
        self.evaluations.insert(Key::Evaluation(step), evaluation);
        Ok(complete)
    }

    /// Opens the evaluation of a snapshot with the seeds of the run; see
    /// [`add_evaluation`](Self::add_evaluation).
    pub fn open(
        &mut self,
        step: u64,
        weights: Hash,
    ) -> Result<Option<Vec<EpisodeScore>>, OtherWeights> {
        let seeds = episode_seeds(self.rules.seed, step, self.rules.episodes);
        self.add_evaluation(step, weights, &seeds)
    }

    /// Opens an online episode.
    pub fn open_online(&mut self, opening: &Opening, weights: Hash) {
        let Opening { episode, seed, .. } = *opening;
        self.online.insert(seed, OnlineEpisodeState::Open { episode });
        self.evaluations.insert(Key::Online(episode), Evaluation::online(opening, weights));
    }

    /// Expects an online episode that an earlier incarnation may have opened.
    pub fn expect_online(&mut self, seed: u64) {
        self.online.insert(seed, OnlineEpisodeState::NotYet);
    }

    /// Ends online learning: evaluators get no more online episodes. Those that are open are still accepted,
    /// those that were expected are refused, since training has come to all that it needs.
    pub fn end_online(&mut self) {
        self.online_ended = true;
        self.online.retain(|_, online| *online != OnlineEpisodeState::NotYet);
    }

    /// Records that training waits for this online episode from `now` on.
    pub fn wait_for_experience(&mut self, episode: u64, now: Instant) {
        self.awaited = Some((episode, now));
    }

    /// Records an online episode, whose frame has this hash, as delivered. Returns the number of
    /// jobs that this ends.
    pub fn record_experience(&mut self, seed: u64, hash: Hash) -> usize {
        let before = self.online.insert(seed, OnlineEpisodeState::Recorded(hash));
        let Some(OnlineEpisodeState::Open { episode }) = before else { return 0 };
        let (key, open) = (Key::Online(episode), self.jobs.len());
        self.evaluations.remove(&key);
        self.jobs.retain(|_, open| open.key != key);
        open - self.jobs.len()
    }

    /// Hash of the snapshot of a step whose episodes are run.
    pub fn weights(&self, step: u64) -> Option<Hash> {
        let evaluation = self.evaluations.get(&Key::Evaluation(step));
        let mut online = self.evaluations.range(..Key::Evaluation(0)).map(|(_, episode)| episode);
        let found = evaluation.or_else(|| online.find(|episode| episode.step == step));
        found.map(|evaluation| evaluation.weights)
    }

    fn of_evaluations(&self) -> impl Iterator<Item = &Evaluation> {
        self.evaluations.range(Key::Evaluation(0)..).map(|(_, evaluation)| evaluation)
    }

    /// Number of episodes that have no score yet, and may still get one: without those that are
    /// [`missing`](Self::missing).
    pub fn pending(&self) -> usize {
        self.of_evaluations().map(Evaluation::pending).sum()
    }

    /// Number of evaluations with pending episodes.
    pub fn evaluations_pending(&self) -> usize {
        self.of_evaluations().filter(|evaluation| evaluation.pending() > 0).count()
    }

    /// Step and seed of the episodes that have no score and are not handed out anymore.
    pub fn missing(&self) -> Vec<(u64, u64)> {
        let mut missing = Vec::new();
        for evaluation in self.evaluations.values() {
            missing.extend(evaluation.given_up().map(|seed| (evaluation.step, seed)));
        }
        missing
    }

    /// Hands out a job: the next online episode, or waiting episodes of the oldest step. An
    /// evaluator has one job at a time; a repeated claim, after a lost answer, gets the same answer.
    pub fn claim(&mut self, claim: Claim<'_>, now: Instant) -> Claimed {
        let Claim { evaluator, attempt, fits, present } = claim;
        if !fits {
            return Claimed::Wait(DOES_NOT_FIT);
        }
        let first = if self.online_ended { Key::Evaluation(0) } else { Key::Online(0) };
        let often = match self.evaluations.first_key_value() {
            _ if self.online_ended || self.online.is_empty() => ASK_AGAIN,
            Some((Key::Online(_), _)) => ASK_FOR_ONLINE,
            _ => ASK_BETWEEN,
        };
        let wait = Claimed::Wait(interval(present, often));
        if let Some(open) = self.jobs.get_mut(evaluator) {
            if open.attempt == attempt {
                return Claimed::Job { job: open.job.clone(), again: true };
            }
            open.asked_again = true;
            return wait;
        }
        let id = self.next_job;
        let online = self.hand_out(first..Key::Evaluation(0), present, now);
        let handed_out = online
            .or_else(|| self.straggler(id, now))
            .or_else(|| self.hand_out(Key::Evaluation(0).., present, now));
        let Some((key, seeds)) = handed_out else { return wait };
        let Evaluation { step, weights, exploration, .. } = &self.evaluations[&key];
        self.next_job += 1;
        let progress = interval(present, PROGRESS);
        // One message may be lost, and the next one late.
        let patience = self.rules.lease.max(3 * progress.min(LONGEST_PROGRESS));
        let job = Job {
            id,
            run: self.rules.run.clone(),
            incarnation: self.rules.incarnation,
            step: *step,
            weights: *weights,
            environment: self.rules.task.environment.clone(),
            environment_seed: self.rules.seed,
            seeds,
            exploration: *exploration,
            // Often enough to keep the lease.
            progress_milliseconds: progress.min(patience / 3).as_millis() as u64,
        };
        let open = OpenJob {
            job: job.clone(),
            key,
            attempt,
            patience,
            asked_again: false,
            handed_out: now,
            lease_until: now + patience,
            done: (0, 0),
        };
        self.jobs.insert(evaluator.clone(), open);
        Claimed::Job { job, again: false }
    }

    /// Hands out the first waiting episodes in this range with the next job.
    fn hand_out(
        &mut self,
        keys: impl RangeBounds<Key>,
        present: usize,
        now: Instant,
    ) -> Option<(Key, Vec<u64>)> {
        let limits = [self.rules.job_episodes[0], self.job_episodes(present)];
        self.evaluations.range_mut(keys).find_map(|(&key, evaluation)| {
            let seeds = evaluation.hand_out(self.next_job, limits, now);
            (!seeds.is_empty()).then_some((key, seeds))
        })
    }

    /// The online episode that training has waited for too long, if one evaluator plays it.
    fn straggler(&mut self, job: u64, now: Instant) -> Option<(Key, Vec<u64>)> {
        let (episode, _) = self.awaited.filter(|(_, since)| now >= *since + STRAGGLER)?;
        let key = Key::Online(episode);
        let players = self.jobs.values().filter(|open| open.key == key).count();
        let evaluation = self.evaluations.get_mut(&key).filter(|_| players == 1)?;
        let seeds = evaluation.hand_out_again(job);
        // It may rest, because a second evaluator has failed.
        (!seeds.is_empty()).then_some((key, seeds))
    }

    /// Most episodes of a job: half of an evaluator's share of those that wait, so that none is
    /// idle in the end. Large jobs take fewer messages, and fewer evaluators that fetch the same
    /// weights.
    fn job_episodes(&self, present: usize) -> usize {
        let waiting: usize = self.of_evaluations().map(Evaluation::waiting).sum();
        let [least, most] = self.rules.job_episodes;
        (waiting / (2 * present.max(1))).clamp(least, most)
    }

    /// The job that an evaluator has, and the number of its episodes that have ended.
    pub fn job_of(&self, evaluator: &Name) -> Option<(&Job, u32)> {
        self.jobs.get(evaluator).map(|open| (&open.job, open.done.1))
    }

    /// Extends the lease of the evaluator's job, if the job is further than before. Returns whether
    /// two evaluators share a name: one that is at a job does not ask for another.
    pub fn progress(&mut self, progress: &Progress, now: Instant) -> Result<bool, Refusal> {
        require(progress.run == self.rules.run, Refusal::Run)?;
        require(progress.incarnation == self.rules.incarnation, Refusal::Incarnation)?;
        let open = self.jobs.get_mut(&progress.evaluator);
        let open = open.filter(|open| open.job.id == progress.job).ok_or(Refusal::Job)?;
        open.advance(progress, now)?;
        Ok(open.asked_again)
    }

    /// Counts the new scores of a report that [`validate`](Self::validate) has accepted.
    pub fn record(&mut self, report: &ScoreReport, new: &[EpisodeScore]) -> Recorded {
        let Some(evaluation) = self.evaluations.get_mut(&Key::Evaluation(report.step)) else {
            return Recorded::default();
        };
        // The report's own job, and others that had some of its episodes because it came late.
        let jobs = evaluation.score(new);
        let done = |seed: &u64| evaluation.is_scored(*seed) == Some(true);
        let open = self.jobs.len();
        self.jobs.retain(|_, OpenJob { job, .. }| {
            !(jobs.contains(&job.id) && job.seeds.iter().all(done))
        });
        let evaluation_completed = if new.is_empty() { None } else { evaluation.scores() };
        Recorded { jobs_completed: open - self.jobs.len(), evaluation_completed }
    }

    /// Extends the lease of a job whose scores have come but are not on the disk yet: its evaluator
    /// has done all that it can.
    pub fn extend_lease(&mut self, evaluator: &Name, incarnation: u64, job: u64, now: Instant) {
        if let Some(open) = self.jobs.get_mut(evaluator)
            && incarnation == self.rules.incarnation
            && job == open.job.id
        {
            open.extend(now, Job::LONGEST);
        }
    }

    /// Takes a job back from an evaluator that leaves, or has `failed` to do it, which counts as if
    /// it had been lost. Returns it and the episodes that are given up; `None` if the evaluator has
    /// no such job.
    pub fn hand_back(
        &mut self,
        evaluator: &Name,
        id: u64,
        failed: Option<Instant>,
    ) -> Option<(Job, Vec<(u64, u64)>)> {
        let job = self.jobs.get(evaluator).filter(|open| open.job.id == id)?.job.clone();
        Some((job, self.release(evaluator, failed).given_up))
    }

    /// Takes back the jobs whose lease has run out.
    pub fn expire(&mut self, now: Instant) -> Lost {
        let expired = self.jobs.iter().filter(|(_, open)| open.lease_until <= now);
        let evaluators = Vec::from_iter(expired.map(|(evaluator, _)| evaluator.clone()));
        let mut lost = Lost { jobs: evaluators.len(), given_up: Vec::new() };
        for evaluator in &evaluators {
            lost.given_up.extend(self.release(evaluator, Some(now)).given_up);
        }
        lost
    }

    /// Ends the job of an evaluator, if it has one, which may be `lost` now. Its episodes wait for the
    /// next job, except those that are given up.
    pub fn release(&mut self, evaluator: &Name, lost: Option<Instant>) -> Lost {
        let Some(OpenJob { key, job, .. }) = self.jobs.remove(evaluator) else {
            return Lost::default();
        };
        let evaluation = self.evaluations.get_mut(&key);
        let given_up = evaluation.map(|it| it.take_back(job.id, &job.seeds, lost));
        let given_up = given_up.into_iter().flatten().map(|seed| (job.step, seed)).collect();
        Lost { jobs: 1, given_up }
    }
}

/// Interval at which one of `present` evaluators may do something: `least`, or `each` times their
/// number if that is longer.
fn interval(present: usize, [least, each]: [Duration; 2]) -> Duration {
    least.max(each * u32::try_from(present).unwrap_or(u32::MAX))
}
