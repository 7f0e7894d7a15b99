//! A learner that has one job and records an evaluator's messages; and the evaluator's process.

use std::process::{Child, Command};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use candle_core::Device;
use quad_nn::{Layout, Weights};
use quad_policy::{Choice, DiffusionShape, Header, MlpConfig, PolicyConfig};
use quad_protocol::{
    Hash, Job, JobReply, JobRequest, Message, Name, Origin, Piece, ScoreReply, ScoreReport,
    Snapshot, decode, encode, keys,
};
use quad_runtime::{Endpoints, open_session, reachable_at};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use zenoh::liveliness::LivelinessToken;
use zenoh::query::Query;
use zenoh::{Session, Wait};

const PATIENCE: Duration = Duration::from_secs(600);
const INCARNATION: u64 = 7;

/// A message of the evaluator.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    Claim,
    /// A request for weights.
    Weights,
    Progress,
    Scores(ScoreReport),
    Piece(Piece),
    /// With the reason.
    HandedBack(Option<String>),
}

impl Event {
    pub fn is_scores(&self) -> bool {
        matches!(self, Event::Scores(_))
    }

    pub fn is_handed_back(&self) -> bool {
        matches!(self, Event::HandedBack(_))
    }
}

/// Reaction to scores, pieces of episodes, claims and returned jobs.
#[derive(Clone, Copy, PartialEq)]
pub enum Behavior {
    Records,
    DiskFull,
    /// Leaves scores without an answer.
    Silent,
    /// Reads nothing more.
    Hangs,
    Refuses,
}

pub struct State {
    events: Vec<Event>,
    pub behavior: Behavior,
    pub incarnation: u64,
    /// Given out until it is done or handed back.
    pub job: Option<Job>,
    /// The frame of an episode, as far as it has come.
    pub frame: Vec<u8>,
}

pub struct Learner {
    pub session: Session,
    pub snapshot: Snapshot,
    endpoint: String,
    state: Arc<Mutex<State>>,
}

/// The file of a small diffusion policy for Hopper with random weights.
pub fn file() -> Vec<u8> {
    file_for("hopper", (11, 3))
}

pub fn file_for(environment: &str, sizes: (usize, usize)) -> Vec<u8> {
    let shape = DiffusionShape::quad(sizes, &MlpConfig::mish(&[8; 3]), 2, 5);
    let mut generator = ChaCha8Rng::seed_from_u64(0);
    let choice = Choice::best_of(2);
    let policy = PolicyConfig::Diffusion { shape, choice };
    let initial = |layout: &Layout| Weights::initial(layout, &mut generator, &Device::Cpu);
    let tensors = policy.tensors(initial).unwrap();
    let origin = Origin { environment: environment.to_owned(), seed: 1, step: 10, episodes: 3 };
    let header = Header::new(policy, origin);
    header.to_safetensors(&tensors).unwrap()
}

pub fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

pub fn snapshot(file: Vec<u8>) -> Snapshot {
    Snapshot { run: name("run"), incarnation: INCARNATION, step: 10, hash: Hash::new(&file), file }
}

pub fn job(snapshot: &Snapshot) -> Job {
    Job {
        id: 1,
        run: name("run"),
        incarnation: INCARNATION,
        step: 10,
        weights: snapshot.hash,
        environment: "hopper".to_owned(),
        environment_seed: 1,
        seeds: vec![11, 12, 13],
        exploration: None,
        progress_milliseconds: 100,
    }
}

fn reply<M: Message>(query: &Query, message: &M) {
    let reply = query.reply(query.key_expr().clone(), encode(message).unwrap());
    reply.wait().unwrap();
}

fn answer(query: &Query, state: &Mutex<State>, weights: &Snapshot) {
    let payload = query.payload().map(|payload| payload.to_bytes());
    let payload = payload.unwrap_or_default();
    let (run, key) = (name("run"), query.key_expr().as_str());
    let mut locked = state.lock().unwrap();
    let incarnation = locked.incarnation;
    if key == keys::weights_at(&run, 10) {
        locked.events.push(Event::Weights);
        reply(query, &snapshot(b"other weights".to_vec()));
        reply(query, weights);
    } else if key == keys::experience(&run) {
        let piece: Piece = decode(&payload).unwrap();
        locked.events.push(Event::Piece(piece.clone()));
        locked.take(piece).into_iter().for_each(|answer| reply(query, &answer));
    } else if key == keys::scores(&run) {
        answer_scores(query, state, locked, decode(&payload).unwrap());
    } else {
        match decode(&payload).unwrap() {
            JobRequest::HandBack { failed, .. } => {
                locked.events.push(Event::HandedBack(failed));
                locked.job = None;
                reply(query, &JobReply::HandedBack { incarnation, accepted: true });
            }
            JobRequest::Claim { .. } => {
                locked.events.push(Event::Claim);
                let wait = JobReply::Wait { incarnation, milliseconds: 100 };
                reply(query, &locked.job.clone().map_or(wait, JobReply::Job));
            }
        }
    }
}

fn answer_scores(
    query: &Query,
    state: &Mutex<State>,
    mut locked: MutexGuard<State>,
    report: ScoreReport,
) {
    let incarnation = locked.incarnation;
    let new = report.episodes.len() as u32;
    locked.job.take_if(|job| job.id == report.job);
    locked.events.push(Event::Scores(report));
    let duplicates = 0;
    let recorded = ScoreReply::Recorded { incarnation, new, duplicates };
    let reason = "the sums differ".to_owned();
    let refused = |incarnation| ScoreReply::Refused { incarnation, reason };
    match locked.behavior {
        Behavior::Records => reply(query, &recorded),
        Behavior::DiskFull => {
            // The answer of a learner that is not followed does not count.
            reply(query, &refused(99));
            query.reply_err("No space left on device").wait().unwrap();
        }
        Behavior::Refuses => reply(query, &refused(incarnation)),
        Behavior::Hangs => {
            drop(locked);
            while state.lock().unwrap().behavior == Behavior::Hangs {
                std::thread::sleep(Duration::from_millis(20));
            }
        }
        _ => {}
    }
}

impl Learner {
    pub async fn start(file: Vec<u8>, behavior: Behavior) -> Learner {
        let any_port = vec!["tcp/127.0.0.1:0".to_owned()];
        let listen = Endpoints { listen: any_port, ..Endpoints::default() };
        let session = open_session(&listen).await.unwrap();
        let endpoint = reachable_at(&session, &listen).await.unwrap().remove(0);
        let (events, frame, incarnation) = (Vec::new(), Vec::new(), INCARNATION);
        let state = State { events, behavior, incarnation, job: None, frame };
        let state = Arc::new(Mutex::new(state));
        let snapshot = snapshot(file);
        let (shared, weights) = (state.clone(), snapshot.clone());
        let callback = move |query: Query| answer(&query, &shared, &weights);
        let queryable = session.declare_queryable("quad/run/**").callback(callback);
        queryable.background().await.unwrap();
        let shared = state.clone();
        let callback = move |_| shared.lock().unwrap().events.push(Event::Progress);
        let progress = keys::progress(&name("run"), keys::ANY);
        let subscriber = session.declare_subscriber(progress).callback(callback);
        subscriber.background().await.unwrap();
        Learner { session, snapshot, endpoint, state }
    }

    /// A learner that gives out its job, beside an older dead one, with an evaluator.
    pub async fn with_job(
        file: Vec<u8>,
        behavior: Behavior,
    ) -> (Learner, Evaluator, impl Sized + use<>) {
        let learner = Learner::start(file, behavior).await;
        learner.give(job(&learner.snapshot));
        let (evaluator, token) = learner.evaluator().await;
        let tokens = (token, learner.announce_dead().await);
        (learner, evaluator, tokens)
    }

    pub fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap()
    }

    pub fn behave(&self, behavior: Behavior) {
        self.lock().behavior = behavior;
    }

    pub fn give(&self, job: Job) {
        self.lock().job = Some(job);
    }

    pub fn events(&self) -> Vec<Event> {
        self.lock().events.clone()
    }

    /// Starts an evaluator and announces the learner.
    pub async fn evaluator(&self) -> (Evaluator, impl Sized + use<>) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_evaluator"));
        command.args(["serve", "--name", "one", "--connect", &self.endpoint]);
        let evaluator = Evaluator(command.spawn().unwrap());
        (evaluator, self.announce(INCARNATION).await)
    }

    /// Announces an older process of the learner, which is dead.
    pub async fn announce_dead(&self) -> LivelinessToken {
        self.announce(INCARNATION - 1).await
    }

    pub async fn announce(&self, incarnation: u64) -> LivelinessToken {
        let key = keys::live_learner(&name("run"), incarnation);
        self.session.liveliness().declare_token(key).await.unwrap()
    }

    pub async fn wait_for<T>(&self, find: impl Fn(&[Event]) -> Option<T>) -> T {
        let begin = Instant::now();
        loop {
            let events = self.events();
            if let Some(found) = find(&events) {
                return found;
            }
            assert!(begin.elapsed() < PATIENCE, "{events:?}");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    pub async fn wait_for_scores(&self, deliveries: usize) -> ScoreReport {
        let last = |events: &[Event]| reports(events).get(deliveries - 1).cloned();
        self.wait_for(last).await
    }

    /// Waits for a job that is handed back, and returns the reason.
    pub async fn wait_for_hand_back(&self) -> Option<String> {
        let find = |event: &Event| match event {
            Event::HandedBack(reason) => Some(reason.clone()),
            _ => None,
        };
        self.wait_for(|events| events.iter().find_map(find)).await
    }

    pub fn count(&self, is_counted: impl Fn(&Event) -> bool) -> usize {
        let events = self.events();
        events.iter().filter(|event| is_counted(event)).count()
    }
}

pub fn reports(events: &[Event]) -> Vec<ScoreReport> {
    let report = |event: &Event| match event {
        Event::Scores(report) => Some(report.clone()),
        _ => None,
    };
    events.iter().filter_map(report).collect()
}

pub struct Evaluator(Child);

impl Evaluator {
    /// Sends SIGTERM. False if it did not leave within its own time limit, as on a busy machine.
    pub fn leave(mut self) -> bool {
        // SAFETY: sends a signal to a process that this one has started and not waited for.
        assert_eq!(unsafe { libc::kill(self.0.id() as i32, libc::SIGTERM) }, 0);
        let code = self.0.wait().unwrap().code();
        assert!(matches!(code, Some(0 | 75)), "{code:?}");
        code == Some(0)
    }
}

/// Tries again where a busy machine was too slow.
pub async fn in_order(attempt: impl AsyncFn() -> bool) {
    let begin = Instant::now();
    while !attempt().await {
        assert!(begin.elapsed() < PATIENCE, "it never leaves within its time limit");
    }
}

impl Drop for Evaluator {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}
