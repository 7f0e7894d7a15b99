//! A learner without training, and what evaluators say to it.

use std::collections::{BTreeMap, HashMap};
use std::net::TcpListener;
use std::sync::Arc;
use std::sync::mpsc::{Sender, channel};
use std::time::{Duration, Instant};

use quad_learner::hub::{self, EvaluationPlan, Hub};
use quad_learner::inbox::{Inbox, inbox};
use quad_learner::metrics::Metrics;
use quad_learner::notice::Notice;
use quad_learner::publisher::{self, Identity, Kept, SnapshotPublisher};
use quad_learner::run_dir::{Log, RunDir};
use quad_learner::scoreboard::{Rules, Scoreboard};
use quad_learner::scribe::{Lines, Scribe};
use quad_learner::trouble::{Saved, Trouble};
use quad_learner::wire::{Life, Wire};
use quad_protocol::{
    Hash, Job, JobReply, JobRequest, Message, Name, Origin, ScoreReply, ScoreReport, decode, encode, keys,
};
use quad_service::{Beat, Endpoints, Health, open_session};
use safetensors::Dtype;
use safetensors::tensor::TensorView;
use tokio::sync::Mutex;
use tokio::sync::mpsc::UnboundedReceiver;
use zenoh::Session;

use crate::common::name;

pub const PATIENCE: Duration = Duration::from_secs(20);
/// Of jobs that are to be lost. Who works tells it much more often, and this machine may stand still for a while meanwhile.
pub const LEASE: Duration = Duration::from_secs(3);
pub const INCARNATION: u64 = 5;

/// A learner without training: its threads, its declarations, its folder.
pub struct Bench {
    pub run: Name,
    pub run_dir: RunDir,
    pub endpoint: String,
    pub metrics: Metrics,
    notices: UnboundedReceiver<Notice>,
    pub publisher: Inbox<publisher::Event>,
    pub hub: Inbox<hub::Event>,
    /// Whoever holds it makes the disk hang; it counts the writes.
    pub disk: Arc<Mutex<usize>>,
    _wire: Wire,
    _folder: tempfile::TempDir,
}

fn beat() -> Beat {
    Health::default().part("a thread", PATIENCE)
}

fn tensors(step: u64) -> Vec<u8> {
    let bytes = vec![step as u8; 1_000_000];
    let tensor = TensorView::new(Dtype::U8, vec![bytes.len()], &bytes).unwrap();
    let shape = "{\"kind\":\"gaussian\",\"observation_dim\":11,\"action_dim\":3,\"hidden\":8}";
    let metadata = HashMap::from([("policy".to_owned(), shape.to_owned())]);
    safetensors::serialize([("weights", tensor)], Some(metadata)).unwrap()
}

/// The file that is published of them.
pub fn file(step: u64) -> Vec<u8> {
    let origin = Origin { environment: "hopper".to_owned(), seed: 1, step, episodes: 4, candidates: 3 };
    origin.attach(&tensors(step)).unwrap()
}

/// Starts a scribe whose disk can hang.
fn scribe(scores: Log, hub: Inbox<hub::Event>, trouble: Trouble, disk: Arc<Mutex<usize>>) -> Sender<Lines> {
    let (sender, before) = channel();
    let (forward, lines) = channel();
    std::thread::spawn(move || Scribe { scores, audits: None, lines, hub, trouble }.run(&beat()));
    std::thread::spawn(move || {
        for lines in before {
            *disk.blocking_lock() += 1;
            forward.send(lines).unwrap();
        }
    });
    sender
}

impl Bench {
    /// Jobs of two episodes, four episodes per evaluation; nobody loses one because this machine stands still.
    pub async fn start() -> Self {
        Self::with_lease(Duration::from_secs(600)).await
    }

    pub async fn with_lease(lease: Duration) -> Self {
        Self::with(lease, 0.0).await
    }

    /// With this share of the episodes scored twice.
    pub async fn with(lease: Duration, audit: f64) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let run = name("bench");
        let (run_dir, scores) = RunDir::create(&folder.path().join("bench"), &config()).unwrap();
        let (metrics, _) = Metrics::new(&run, 100, &[]).unwrap();
        let (notify, notices) = tokio::sync::mpsc::unbounded_channel();
        let task = quad_dataset::Task::from(quad_dataset::environment::find("hopper").unwrap());
        let rules = Rules {
            run: run.clone(),
            incarnation: INCARNATION,
            task: task.clone(),
            instance: 1,
            candidates: 3,
            job_episodes: [2, 2],
            lease,
            audit,
        };
        let plan = EvaluationPlan { seed: 1, episodes: 4 };
        let (hub, messages) = inbox();
        let disk = Arc::new(Mutex::new(0));
        let trouble = Trouble::new(Saved::Scores, &metrics.disk, notify.clone());
        let scribe = scribe(scores, hub.clone(), trouble, disk.clone());
        let state = Hub::new(run.clone(), plan, Scoreboard::new(rules), scribe, metrics.clone(), notify.clone());
        std::thread::spawn(move || state.run(&messages, &beat()));
        let identity = Identity { run: run.clone(), incarnation: INCARNATION, task };
        let past = BTreeMap::new();
        let state = SnapshotPublisher::new(identity, run_dir.clone(), metrics.clone(), hub.clone(), notify, past);
        let (publisher, messages) = inbox();
        std::thread::spawn(move || state.run(&messages, &beat()));

        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let endpoint = format!("tcp/127.0.0.1:{port}");
        let session =
            open_session(&Endpoints { listen: vec![endpoint.clone()], ..Endpoints::default() }).await.unwrap();
        let life = Life { run: run.clone(), incarnation: INCARNATION, behind_router: false };
        let wire = Wire::declare(session, life, &hub, &publisher, &metrics, || Ok(())).await.unwrap();
        Self { run, run_dir, endpoint, metrics, notices, publisher, hub, disk, _wire: wire, _folder: folder }
    }

    pub async fn client(&self) -> Session {
        open_session(&Endpoints { connect: vec![self.endpoint.clone()], ..Endpoints::default() }).await.unwrap()
    }

    pub async fn snapshot(&mut self, step: u64) {
        let tensors = file(step);
        self.run_dir.write_snapshot(step, &tensors).unwrap();
        let kept = Kept { step, kind: "diffusion", hash: Hash::of(&tensors), tensors };
        self.publisher.send(publisher::Event::Kept(kept));
        self.until(|notice| matches!(notice, Notice::Published { step: published } if *published == step)).await;
    }

    pub async fn until(&mut self, wanted: impl Fn(&Notice) -> bool) -> Notice {
        let search = async {
            loop {
                let notice = self.notices.recv().await.unwrap();
                if wanted(&notice) {
                    return notice;
                }
            }
        };
        tokio::time::timeout(PATIENCE, search).await.expect("the notice comes in time")
    }

    pub fn rejected(&self, reason: &str) -> u64 {
        self.metrics.rejected.with_label_values(&[reason]).get()
    }

    pub fn lines(&self) -> usize {
        self.run_dir.read_scores().unwrap().len()
    }
}

fn config() -> quad_learner::config::RunConfig {
    let text = r#"
        [run]
        name = "bench"
        incarnation = 5
        preset = "hopper-demo"
        version = "0"
        [dataset]
        path = "none"
        transitions = 0
        episodes = 0
        min_return = 0.0
        mean_return = 0.0
        max_return = 0.0
        mean_score = 0.0
    "#;
    let mut table: toml::Table = text.parse().unwrap();
    let experiment = quad_learner::config::resolve("hopper-demo", &Default::default()).unwrap();
    table.insert("experiment".into(), toml::Value::try_from(experiment).unwrap());
    table.try_into().unwrap()
}

/// The answer, or the text of the error that came instead; nothing if nobody answered.
pub async fn ask<A: Message>(session: &Session, key: String, payload: Option<Vec<u8>>) -> Option<Result<A, String>> {
    let get = session.get(key).timeout(PATIENCE);
    let replies = match payload {
        Some(payload) => get.payload(payload).await.unwrap(),
        None => get.await.unwrap(),
    };
    let reply = replies.recv_async().await.ok()?;
    Some(match reply.into_result() {
        Ok(sample) => Ok(decode(&sample.payload().to_bytes()).unwrap()),
        Err(error) => Err(error.payload().try_to_string().unwrap().into_owned()),
    })
}

pub fn claim_message(evaluator: &str, attempt: u64) -> JobRequest {
    JobRequest::Claim {
        evaluator: name(evaluator),
        attempt,
        environments: vec!["hopper".into()],
        precision: name("f32"),
    }
}

pub async fn ask_for_job(session: &Session, run: &Name, request: &JobRequest) -> JobReply {
    ask(session, keys::jobs(run), Some(encode(request).unwrap())).await.unwrap().unwrap()
}

pub async fn claim(session: &Session, run: &Name, evaluator: &str) -> Option<Job> {
    match ask_for_job(session, run, &claim_message(evaluator, 1)).await {
        JobReply::Job(job) => Some(job),
        _ => None,
    }
}

pub async fn claim_eventually(session: &Session, run: &Name, evaluator: &str) -> Job {
    let start = Instant::now();
    loop {
        if let Some(job) = claim(session, run, evaluator).await {
            return job;
        }
        assert!(start.elapsed() < PATIENCE, "no job for {evaluator}");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

pub async fn deliver(session: &Session, report: &ScoreReport) -> ScoreReply {
    ask(session, keys::scores(&report.run), Some(encode(report).unwrap())).await.unwrap().unwrap()
}
