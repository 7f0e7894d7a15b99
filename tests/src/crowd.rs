//! Evaluators that do everything on the wire and nothing else: they claim, report progress and deliver scores that they made
//! up. Hundreds of them fit into one test.

use std::mem;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use quad_dataset::environment;
use quad_protocol::{
    EpisodeScore, Job, JobReply, Message, Name, Progress, ScoreReply, ScoreReport, decode, encode, keys,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::{Config, Session};

use crate::PATIENCE;
use crate::made_up::{self, name};

/// Its pause after a question without an answer.
const PAUSE: Duration = Duration::from_millis(250);

/// Most episodes of a job.
const MOST_EPISODES: u32 = 40;

/// A job at a real pace takes no longer than this, of episodes that take no longer than `episode`.
pub fn longest_job(episode: Duration) -> Duration {
    MOST_EPISODES * episode
}

/// What a crowd does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// Nothing but staying connected.
    Still,
    /// A job takes some seconds, with progress meanwhile, as with real episodes.
    Real,
    /// A job takes a twentieth of that, so that there is a claim at every moment.
    Quick,
}

/// What a crowd has measured since it was last asked.
#[derive(Clone, Debug, Default)]
pub struct Measured {
    /// How long each answer to a claim took.
    pub claims: Vec<Duration>,
    /// How long each acknowledgement of scores took.
    pub reports: Vec<Duration>,
    /// Questions without an answer.
    pub unanswered: usize,
    /// Scores that the learner acknowledged: step, seed, weights.
    pub acknowledged: Vec<(u64, u64, String)>,
    /// Reports that it refused.
    pub refused: usize,
}

impl Measured {
    /// Adds what was measured later.
    pub fn add(&mut self, later: Measured) {
        self.claims.extend(later.claims);
        self.reports.extend(later.reports);
        self.unanswered += later.unanswered;
        self.acknowledged.extend(later.acknowledged);
        self.refused += later.refused;
    }
}

/// Many light evaluators of one run.
pub struct Crowd {
    shared: Arc<Shared>,
    _tasks: JoinSet<()>,
}

struct Shared {
    run: Name,
    /// The longest episode at a real pace; the shortest takes half as long.
    episode: Duration,
    pace: Mutex<Pace>,
    /// Evaluators that have a job.
    busy: AtomicUsize,
    measured: Mutex<Measured>,
}

impl Crowd {
    /// Connects `count` evaluators of `run`, each with a session of its own, to `endpoint`. At a real pace, an episode takes
    /// up to `episode`.
    pub async fn connect(count: usize, episode: Duration, run: &Name, endpoint: &str) -> Crowd {
        let shared = Arc::new(Shared {
            run: run.clone(),
            episode,
            pace: Mutex::new(Pace::Still),
            busy: AtomicUsize::new(0),
            measured: Mutex::default(),
        });
        let mut tasks = JoinSet::new();
        for number in 0..count {
            let member = Member::connect(number, endpoint, shared.clone()).await;
            tasks.spawn(member.work());
        }
        Crowd { shared, _tasks: tasks }
    }

    /// From now on, all of them do this. A job that was begun is still done.
    pub fn set(&self, pace: Pace) {
        *self.shared.pace.lock().unwrap() = pace;
    }

    /// How many have a job.
    pub fn busy(&self) -> usize {
        self.shared.busy.load(Relaxed)
    }

    /// What was measured since this was last called.
    pub fn measured(&self) -> Measured {
        mem::take(&mut *self.shared.measured.lock().unwrap())
    }
}

impl Shared {
    fn pace(&self) -> Pace {
        *self.pace.lock().unwrap()
    }

    fn note(&self, note: impl FnOnce(&mut Measured)) {
        note(&mut self.measured.lock().unwrap());
    }
}

struct Member {
    name: Name,
    session: Session,
    shared: Arc<Shared>,
    random: ChaCha8Rng,
    /// When it last told its progress.
    told: Option<Instant>,
    /// Has had no job yet since it was still.
    begins: bool,
}

impl Member {
    async fn connect(number: usize, endpoint: &str, shared: Arc<Shared>) -> Member {
        let mut config = Config::default();
        let endpoints = format!("[{endpoint:?}]");
        for (key, value) in
            [("mode", "\"client\""), ("connect/endpoints", &endpoints), ("scouting/multicast/enabled", "false")]
        {
            config.insert_json5(key, value).expect("the setting exists");
        }
        let session = zenoh::open(config).await.expect("the endpoint is open");
        let name = name(&format!("light-{number}"));
        let random = ChaCha8Rng::seed_from_u64(number as u64);
        Member { name, session, shared, random, told: None, begins: true }
    }

    async fn work(mut self) {
        let run = self.shared.run.clone();
        let token = self.session.liveliness().declare_token(keys::live_evaluator(&run, &self.name)).await;
        let _token = token.expect("the session is open");
        let woken = Arc::new(tokio::sync::Notify::new());
        let wake = woken.clone();
        let snapshots = self.session.declare_subscriber(keys::weights(&run)).callback(move |_| wake.notify_one()).await;
        let _snapshots = snapshots.expect("the session is open");
        loop {
            if self.shared.pace() == Pace::Still {
                self.begins = true;
                sleep(Duration::from_millis(100)).await;
                continue;
            }
            match self.claim().await {
                Some(JobReply::Job(job)) => {
                    self.shared.busy.fetch_add(1, Relaxed);
                    self.score(job).await;
                    self.shared.busy.fetch_sub(1, Relaxed);
                }
                Some(JobReply::Wait { milliseconds, .. }) => {
                    // A new snapshot wakes a real evaluator, too.
                    let wait = Duration::from_millis(milliseconds).mul_f64(self.random.random_range(0.5..1.0));
                    timeout(wait, woken.notified()).await.ok();
                }
                _ => sleep(PAUSE).await,
            }
        }
    }

    async fn claim(&mut self) -> Option<JobReply> {
        let claim = made_up::claim(self.name.as_str(), self.random.random(), "hopper");
        let (answer, took) = self.ask(keys::jobs(&self.shared.run), &claim).await?;
        self.shared.note(|measured| measured.claims.push(took));
        Some(answer)
    }

    async fn score(&mut self, job: Job) {
        self.act(&job).await;
        let spec = environment::find("hopper").expect("hopper is known");
        let episodes = job.seeds.iter().map(|&seed| {
            let episode_return = (seed % 3000) as f64;
            EpisodeScore { seed, episode_return, length: 300, score: spec.normalised_score(episode_return) }
        });
        let report = ScoreReport::of(&job, self.name.clone(), name("f32"), episodes.collect());
        // What was not answered is delivered again.
        while self.deliver(&report).await.is_none() {
            sleep(PAUSE).await;
        }
    }

    /// Takes the time that a job takes, and tells its progress.
    async fn act(&mut self, job: &Job) {
        let episode = match self.shared.pace() {
            Pace::Real => self.shared.episode,
            Pace::Quick => self.shared.episode / 20,
            Pace::Still => return,
        };
        let longest = episode * job.seeds.len() as u32;
        let mut left = self.random.random_range(longest / 2..longest);
        // They all begin together, and should not go on so.
        if mem::take(&mut self.begins) {
            left = left.mul_f64(self.random.random());
        }
        let every = Duration::from_millis(job.progress_milliseconds);
        let mut steps_done = 0;
        while !left.is_zero() {
            // Like a real one, it does not tell more because its jobs are short.
            if self.told.is_none_or(|told| told.elapsed() >= every) {
                self.told = Some(Instant::now());
                self.progress(job, steps_done).await;
            }
            sleep(every.min(left)).await;
            left = left.saturating_sub(every);
            steps_done += 1;
        }
    }

    async fn deliver(&mut self, report: &ScoreReport) -> Option<()> {
        let (answer, took) = self.ask::<ScoreReply>(keys::scores(&report.run), report).await?;
        let recorded = matches!(answer, ScoreReply::Recorded { .. });
        let scores = report.episodes.iter().map(|episode| (report.step, episode.seed, report.weights.to_string()));
        self.shared.note(|measured| {
            measured.reports.push(took);
            match recorded {
                true => measured.acknowledged.extend(scores),
                false => measured.refused += 1,
            }
        });
        Some(())
    }

    async fn progress(&self, job: &Job, steps_done: u64) {
        let progress = Progress { steps_done, environment_steps: steps_done, ..Progress::of(job, self.name.clone()) };
        let message = encode(&progress).expect("it is small");
        self.session.put(keys::progress(&job.run, &self.name), message).await.expect("the session is open");
    }

    /// The answer and how long it took.
    async fn ask<A: Message>(&mut self, key: String, question: &impl Message) -> Option<(A, Duration)> {
        let begin = Instant::now();
        let get = self.session.get(&key).payload(encode(question).expect("it is small")).timeout(PATIENCE);
        let get = get.target(QueryTarget::All).consolidation(ConsolidationMode::None).await;
        let reply = get.expect("the session is open").recv_async().await.ok();
        let Some(Ok(sample)) = reply.map(|reply| reply.into_result()) else {
            self.shared.note(|measured| measured.unanswered += 1);
            return None;
        };
        Some((decode(&sample.payload().to_bytes()).expect("the learner's answer"), begin.elapsed()))
    }
}
