//! Measures a learner under load: evaluators behind one router that say everything on the wire, and
//! make up what they deliver.
//!
//! ```sh
//! cargo run --release -p quad-tests --example load -- 500 1600    # evaluators, milliseconds of an episode
//! cargo run --release -p quad-tests --example load -- 8 online    # rows of experience, as fast as they are written
//! ```
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stdout)]

use std::env;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use quad_dataset::environment;
use quad_protocol::{
    Episode, EpisodeScore, Hash, Job, JobReply, Message, Name, Piece, PieceReply, Progress,
    ScoreReply, ScoreReport, decode, encode, keys,
};
use quad_runtime::open_router;
use quad_tests::made_up::{claim, client, name};
use quad_tests::setting::{ENDLESS, Setting};
use quad_tests::system::Scratch;
use tokio::task::JoinSet;
use tokio::time::sleep;
use zenoh::Session;

/// Time that is measured.
const MEASURED: Duration = Duration::from_secs(60);
/// With more episodes than any crowd can score meanwhile.
const BUSY: Setting =
    Setting { eval_interval: 30_000, episodes: 10_000, candidates: 1, hidden: 64, ..ENDLESS };
/// Takes in experience, and trains nothing.
const ONLINE: [&str; 6] =
    ["--online-steps", "100000000", "--set", "online.warmup=90000000", "--set", "online.lag=128"];

/// Times of the answers to claims and to deliveries.
type Times = Arc<Mutex<[Vec<Duration>; 2]>>;

struct Evaluator {
    name: Name,
    session: Session,
    /// Longest episode; the shortest takes half as long.
    episode: Duration,
    times: Times,
}

impl Evaluator {
    async fn work(self) {
        let run = name("run");
        let token = self.session.liveliness().declare_token(keys::live_evaluator(&run, &self.name));
        let _token = token.await.unwrap();
        for attempt in 1.. {
            let claim = claim(self.name.as_str(), attempt, "hopper");
            match self.ask(0, keys::jobs(&run), &claim).await {
                JobReply::Job(job) if job.exploration.is_some() => self.deliver_episode(&job).await,
                JobReply::Job(job) => self.play(&job, attempt).await,
                JobReply::Wait { milliseconds, .. } => {
                    sleep(Duration::from_millis(milliseconds)).await;
                }
                answer => panic!("{answer:?}"),
            }
        }
    }

    /// The answer to a question, whose time it notes among those.
    async fn ask<A: Message>(&self, times: usize, key: String, question: &impl Message) -> A {
        let begin = Instant::now();
        let replies = self.session.get(key).payload(encode(question).unwrap()).await.unwrap();
        let reply = replies.recv_async().await.expect("the learner answers");
        let answer = decode(&reply.result().unwrap().payload().to_bytes()).unwrap();
        self.times.lock().unwrap()[times].push(begin.elapsed());
        answer
    }

    async fn play(&self, job: &Job, attempt: u64) {
        let every = Duration::from_millis(job.progress_milliseconds);
        let (begin, mut steps_done) = (Instant::now(), 0);
        let whole = self.episode * job.seeds.len() as u32;
        let whole = whole.mul_f64(0.5 + 0.05 * (attempt % 11) as f64);
        while let Some(left) = whole.checked_sub(begin.elapsed()) {
            steps_done += 1;
            let progress = Progress {
                steps_done,
                environment_steps: steps_done,
                ..Progress::new(job, self.name.clone())
            };
            let key = keys::progress(&job.run, &self.name);
            self.session.put(key, encode(&progress).unwrap()).await.unwrap();
            sleep(every.min(left)).await;
        }
        let scores = job.seeds.iter().map(|&seed| score(seed, 300, (seed % 3000) as f64));
        let report = ScoreReport::new(job, self.name.clone(), name("f32"), scores.collect());
        let answer = self.ask(1, keys::scores(&job.run), &report).await;
        assert!(matches!(answer, ScoreReply::Recorded { .. }), "{answer:?}");
    }

    async fn deliver_episode(&self, job: &Job) {
        let (steps, seed) = (1000, job.seeds[0]);
        let episode = Episode {
            score: score(seed, steps as u32, 2.0 * steps as f64),
            observations: vec![0.1; (steps + 1) * 11],
            actions: vec![0.1; steps * 3],
            rewards: vec![2.0; steps],
            ..Episode::new(job.step, job.weights, name("f32"), seed)
        };
        let frame = encode(&episode).unwrap();
        let mut piece = Piece {
            evaluator: self.name.clone(),
            run: job.run.clone(),
            incarnation: job.incarnation,
            job: job.id,
            seed,
            hash: Hash::new(&frame),
            length: frame.len() as u32,
            offset: 0,
            bytes: Vec::new(),
        };
        loop {
            let rest = &frame[piece.offset as usize..];
            piece.bytes = rest[..rest.len().min(Piece::MOST)].to_vec();
            match self.ask(1, keys::experience(&job.run), &piece).await {
                PieceReply::Continue { offset, .. } => piece.offset = offset,
                PieceReply::Recorded { .. } => return,
                answer => panic!("{answer:?}"),
            }
        }
    }
}

fn score(seed: u64, length: u32, episode_return: f64) -> EpisodeScore {
    let hopper = environment::find("hopper").unwrap();
    EpisodeScore { seed, episode_return, length, score: hopper.normalized_score(episode_return) }
}

#[tokio::main]
async fn main() {
    let arguments = Vec::from_iter(env::args().skip(1));
    let [count, episode] = &arguments[..] else { panic!("two arguments, as above") };
    let scratch = Scratch::new();
    let (_router, endpoint) = open_router().await.unwrap();
    let connect = ["--connect", &endpoint];
    let flags = if episode == "online" { [&connect[..], &ONLINE].concat() } else { connect.into() };
    let online = Setting { steps: 100, eval_interval: 50, ..ENDLESS };
    let setting = if episode == "online" { online } else { BUSY };
    let learner = scratch.learner_with("run", setting, &flags);
    learner.process.wait_for_log("snapshot handed to evaluation");
    let alone = learner.process.peak_memory();
    let times = Times::default();
    let episode = Duration::from_millis(episode.parse().unwrap_or(0));
    let mut evaluators = JoinSet::new();
    for number in 0..count.parse().unwrap() {
        let (session, times) = (client(&endpoint).await, times.clone());
        let name = name(&format!("light-{number}"));
        evaluators.spawn(Evaluator { name, session, episode, times }.work());
    }
    sleep(Duration::from_secs(5)).await;
    *times.lock().unwrap() = Default::default();
    let rows = learner.metric("experience_rows", "").unwrap();
    sleep(MEASURED).await;
    let rows = learner.metric("experience_rows", "").unwrap() - rows;
    evaluators.shutdown().await;
    let seconds = MEASURED.as_secs_f64();
    for (kind, times) in ["claims", "deliveries"].iter().zip(&mut *times.lock().unwrap()) {
        times.sort_unstable();
        let share = |share: f64| times[(times.len() as f64 * share) as usize];
        let (rate, middle, p99) = (times.len() as f64 / seconds, share(0.5), share(0.99));
        println!("{rate:.0} {kind}/s, median {middle:.1?}, of a hundred one takes {p99:.1?}");
    }
    let memory = learner.process.peak_memory();
    println!("{:.0} rows/s; memory {} MiB, {} alone", rows / seconds, memory >> 20, alone >> 20);
}
