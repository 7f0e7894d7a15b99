//! Evaluators that do everything on the wire and nothing else: they claim, report progress and
//! deliver scores, or online rows, that they made up. Hundreds of them fit into one test.

use std::mem;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use quad_protocol::{
    Job, JobReply, Message, Name, PieceReply, Progress, ScoreReply, ScoreReport, encode, keys,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};
use zenoh::Session;

use crate::made_up::{self, name};

/// Pause after a question without an answer.
const PAUSE: Duration = Duration::from_millis(250);

/// Times and counts since the last reading.
#[derive(Clone, Debug, Default)]
pub struct Measured {
    pub claims: Vec<Duration>,
    pub reports: Vec<Duration>,
    /// Questions without an answer.
    pub unanswered: usize,
    /// Scores that the learner acknowledged: step, seed, weights.
    pub acknowledged: Vec<(u64, u64, String)>,
    pub refused: usize,
}

pub struct Crowd {
    shared: Arc<Shared>,
    _tasks: JoinSet<()>,
}

struct Shared {
    run: Name,
    /// The longest episode; the shortest takes half as long.
    episode: Duration,
    busy: AtomicUsize,
    measured: Mutex<Measured>,
}

impl Crowd {
    /// Connects `count` evaluators of `run`, each with its own session, to `endpoint`. An episode
    /// takes up to `episode`.
    pub async fn connect(count: usize, episode: Duration, run: &Name, endpoint: &str) -> Crowd {
        let (busy, measured) = Default::default();
        let shared = Arc::new(Shared { run: run.clone(), episode, busy, measured });
        let mut tasks = JoinSet::new();
        for number in 0..count {
            let session = made_up::client(endpoint).await;
            let random = ChaCha8Rng::seed_from_u64(number as u64);
            let name = name(&format!("light-{number}"));
            tasks
                .spawn(Member { name, session, shared: shared.clone(), random, told: None }.work());
        }
        Crowd { shared, _tasks: tasks }
    }

    pub fn busy(&self) -> usize {
        self.shared.busy.load(Relaxed)
    }

    /// Returns the measurements since the last call.
    pub fn measured(&self) -> Measured {
        mem::take(&mut *self.shared.measured.lock().unwrap())
    }
}

struct Member {
    name: Name,
    session: Session,
    shared: Arc<Shared>,
    random: ChaCha8Rng,
    told: Option<Instant>,
}

impl Member {
    async fn work(mut self) {
        let run = self.shared.run.clone();
        let token =
            self.session.liveliness().declare_token(keys::live_evaluator(&run, &self.name)).await;
        let _token = token.expect("the session is open");
        let woken = Arc::new(tokio::sync::Notify::new());
        let wake = woken.clone();
        let snapshots = self
            .session
            .declare_subscriber(keys::weights(&run))
            .callback(move |_| wake.notify_one())
            .await;
        let _snapshots = snapshots.expect("the session is open");
        loop {
            let claim = made_up::claim(self.name.as_str(), self.random.random(), "hopper");
            match self.ask(keys::jobs(&run), &claim, |measured| &mut measured.claims).await {
                Some(JobReply::Job(job)) => {
                    self.shared.busy.fetch_add(1, Relaxed);
                    if job.exploration.is_some() {
                        // Made up in no time.
                        let (session, name) = (&self.session, self.name.as_str());
                        let answer = made_up::deliver_experience(session, &job, name).await;
                        let refused = matches!(answer, PieceReply::Refused { .. });
                        self.shared.measured.lock().unwrap().refused += usize::from(refused);
                    } else {
                        self.act(&job).await;
                        self.deliver(&made_up::scores(&job, self.name.as_str())).await;
                    }
                    self.shared.busy.fetch_sub(1, Relaxed);
                }
                Some(JobReply::Wait { milliseconds, .. }) => {
                    // A new snapshot wakes a real evaluator, too.
                    let wait = Duration::from_millis(milliseconds)
                        .mul_f64(self.random.random_range(0.5..1.0));
                    timeout(wait, woken.notified()).await.ok();
                }
                _ => sleep(PAUSE).await,
            }
        }
    }

    /// Sleeps as long as a job takes, and reports progress.
    async fn act(&mut self, job: &Job) {
        let longest = self.shared.episode * job.seeds.len() as u32;
        let mut left = self.random.random_range(longest / 2..=longest);
        let every = Duration::from_millis(job.progress_milliseconds);
        let mut steps_done = 0;
        while !left.is_zero() {
            // Like a real one, it does not tell more because its jobs are short.
            if self.told.is_none_or(|told| told.elapsed() >= every) {
                self.told = Some(Instant::now());
                let of_job = Progress::new(job, self.name.clone());
                let progress = Progress { steps_done, environment_steps: steps_done, ..of_job };
                let message = encode(&progress).expect("it is small");
                let put = self.session.put(keys::progress(&job.run, &self.name), message);
                put.await.expect("the session is open");
            }
            sleep(every.min(left)).await;
            left = left.saturating_sub(every);
            steps_done += 1;
        }
    }

    /// Delivers scores, again and again until there is an answer.
    async fn deliver(&self, report: &ScoreReport) {
        let answer = loop {
            let key = keys::scores(&report.run);
            match self.ask::<ScoreReply>(key, report, |measured| &mut measured.reports).await {
                Some(answer) => break answer,
                None => sleep(PAUSE).await,
            }
        };
        let mut measured = self.shared.measured.lock().unwrap();
        let scores = report
            .episodes
            .iter()
            .map(|episode| (report.step, episode.seed, report.weights.to_string()));
        match answer {
            ScoreReply::Recorded { .. } => measured.acknowledged.extend(scores),
            ScoreReply::NotYet { .. } | ScoreReply::Refused { .. } => measured.refused += 1,
        }
    }

    /// The answer; notes how long it took.
    async fn ask<A: Message>(
        &self,
        key: String,
        question: &impl Message,
        times: fn(&mut Measured) -> &mut Vec<Duration>,
    ) -> Option<A> {
        let begin = Instant::now();
        let answer = made_up::ask(&self.session, key, question).await;
        let mut measured = self.shared.measured.lock().unwrap();
        match answer {
            Some(_) => times(&mut measured).push(begin.elapsed()),
            None => measured.unanswered += 1,
        }
        answer
    }
}
