//! A learner without training over real Zenoh, and what evaluators say to it.

mod disk;
mod jobs;
mod peers;
mod scores;
mod weights;

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::sync::Arc;
use std::time::{Duration, Instant};

use quad_protocol::{Hash, Job, JobReply, JobRequest, Message, Name, ScoreReply, ScoreReport, decode, encode, keys};
use quad_run::run::{Log, RunDir};
use quad_runtime::{Beat, Endpoints, Health, open_session};
use tokio::sync::Mutex;
use tokio::sync::mpsc::UnboundedReceiver;
use zenoh::Session;

use super::coordinator::{Coordinator, EvaluationPlan};
use super::disk::DiskStatus;
use super::duplicate::Incarnation;
use super::events::{Event, Saved};
use super::metrics::Metrics;
use super::network::Wire;
use super::scores::Scores;
use super::services::Services;
use super::snapshots::Snapshots;
use super::spawn::spawn;
use super::weights::Weights;
use crate::evaluation::Rules;
use crate::evaluation::tests::name;
use crate::fixtures::config;
use crate::train::{Outbox, TrainedPolicy};

const PATIENCE: Duration = Duration::from_secs(60);
/// Lease of jobs that are to be lost. An evaluator at work reports much more often, and this machine may stand still
/// for a while.
const LEASE: Duration = Duration::from_secs(6);
const INCARNATION: u64 = 5;

/// A learner without training: its threads, its declarations, its folder.
struct Bench {
    run: Name,
    run_dir: RunDir,
    endpoint: String,
    metrics: Metrics,
    events: UnboundedReceiver<Event>,
    outbox: Outbox,
    coordinator: Coordinator,
    /// While a test holds it, scores do not get to the disk.
    disk: Arc<Mutex<()>>,
    _wire: Wire,
    _folder: tempfile::TempDir,
}

/// The file of a policy, which the learner's threads do not look into.
fn file(step: u64) -> Vec<u8> {
    vec![step as u8; 1_000_000]
}

fn beat() -> Beat {
    Health::default().part("a thread", PATIENCE)
}

impl Bench {
    /// Jobs of two episodes, four episodes per evaluation; none is lost because this machine stands still.
    async fn start() -> Self {
        Self::with(Duration::from_secs(600), |_| ()).await
    }

    async fn with_lease(lease: Duration) -> Self {
        Self::with(lease, |_| ()).await
    }

    /// With another log of scores.
    async fn with(lease: Duration, change: impl Fn(&mut Log)) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let run = name("bench");
        let (run_dir, mut log) = RunDir::create(&folder.path().join("bench"), &config("bench", 1)).unwrap();
        change(&mut log);
        let (metrics, _) = Metrics::new(&run, 100, &[]).unwrap();
        let (tell, events) = tokio::sync::mpsc::unbounded_channel();
        let task = quad_dataset::Task::from(quad_dataset::environment::find("hopper").unwrap());
        let rules = Rules {
            run: run.clone(),
            incarnation: INCARNATION,
            task,
            environment_seed: 1,
            job_episodes: [2, 2],
            lease,
        };
        let plan = EvaluationPlan { seed: 1, episodes: 4 };
        let coordinator = Coordinator::new(rules, plan, BTreeMap::new(), metrics.clone(), tell.clone());
        let weights = Weights::new(run.clone(), INCARNATION, run_dir.clone(), coordinator.clone());
        let (services, before) =
            Services::start(coordinator.clone(), weights.clone(), metrics.clone(), tell.clone()).unwrap();

        let (forward, deliveries) = std::sync::mpsc::channel();
        let disk = Arc::new(Mutex::new(()));
        let hanging = disk.clone();
        std::thread::spawn(move || {
            for delivery in before {
                let _there = hanging.blocking_lock();
                forward.send(delivery).unwrap();
            }
        });
        let status = |what| DiskStatus::new(what, &metrics.disk, tell.clone());
        let (coordinates, disk_status) = (coordinator.clone(), status(Saved::Scores));
        let scores = Scores { log, deliveries, coordinator: coordinates, metrics: metrics.clone(), disk: disk_status };
        spawn("scores", &tell, move || scores.run(&beat())).unwrap();
        let outbox = Outbox::default();
        let snapshots = Snapshots {
            outbox: outbox.clone(),
            run_dir: run_dir.clone(),
            rows: run_dir.metrics_log(0).unwrap().0,
            weights,
            metrics: metrics.clone(),
            events: tell.clone(),
            known: BTreeMap::new(),
            disk: status(Saved::Run),
        };
        spawn("snapshots", &tell, move || snapshots.run(&beat())).unwrap();

        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let endpoint = format!("tcp/127.0.0.1:{port}");
        let session =
            open_session(&Endpoints { listen: vec![endpoint.clone()], ..Endpoints::default() }).await.unwrap();
        let incarnation = Incarnation { run: run.clone(), number: INCARNATION };
        let wire = Wire::declare(session, &incarnation, &services).await.unwrap();
        Self { run, run_dir, endpoint, metrics, events, outbox, coordinator, disk, _wire: wire, _folder: folder }
    }

    async fn client(&self) -> Session {
        open_session(&Endpoints { connect: vec![self.endpoint.clone()], ..Endpoints::default() }).await.unwrap()
    }

    /// Training hands over a snapshot.
    fn train(&self, step: u64) {
        self.outbox.snapshot(TrainedPolicy { step, file: file(step), evaluate: true }, &false.into(), &beat());
    }

    async fn snapshot(&mut self, step: u64) {
        self.train(step);
        self.until(|event| matches!(event, Event::Published { step: published } if *published == step)).await;
    }

    async fn until(&mut self, wanted: impl Fn(&Event) -> bool) -> Event {
        let search = async {
            loop {
                let event = self.events.recv().await.unwrap();
                if wanted(&event) {
                    return event;
                }
            }
        };
        tokio::time::timeout(PATIENCE, search).await.expect("the event comes in time")
    }

    fn rejected(&self, reason: &str) -> u64 {
        self.metrics.rejected.with_label_values(&[reason]).get()
    }

    fn lines(&self) -> usize {
        self.run_dir.read_scores().unwrap().len()
    }
}

/// The answer, or the text of the error that came instead; nothing if no answer came. As an evaluator does, the client asks again
/// where the learner has closed its connection, which it does with one that reads nothing for two seconds on a busy machine.
async fn ask<A: Message>(session: &Session, key: String, payload: Option<Vec<u8>>) -> Option<Result<A, String>> {
    let start = Instant::now();
    while start.elapsed() < PATIENCE {
        let get = session.get(&key).timeout(PATIENCE);
        let replies = match &payload {
            Some(payload) => get.payload(payload).await.unwrap(),
            None => get.await.unwrap(),
        };
        let Ok(reply) = replies.recv_async().await else {
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        return Some(match reply.into_result() {
            Ok(sample) => Ok(decode(&sample.payload().to_bytes()).unwrap()),
            Err(error) => Err(error.payload().try_to_string().unwrap().into_owned()),
        });
    }
    None
}

fn claim_message(evaluator: &str, attempt: u64) -> JobRequest {
    JobRequest::Claim { evaluator: name(evaluator), attempt, environments: vec!["hopper".into()] }
}

async fn ask_for_job(session: &Session, run: &Name, request: &JobRequest) -> JobReply {
    ask(session, keys::jobs(run), Some(encode(request).unwrap())).await.unwrap().unwrap()
}

async fn claim(session: &Session, run: &Name, evaluator: &str) -> Option<Job> {
    match ask_for_job(session, run, &claim_message(evaluator, 1)).await {
        JobReply::Job(job) => Some(job),
        _ => None,
    }
}

async fn claim_eventually(session: &Session, run: &Name, evaluator: &str) -> Job {
    let start = Instant::now();
    loop {
        if let Some(job) = claim(session, run, evaluator).await {
            return job;
        }
        assert!(start.elapsed() < PATIENCE, "no job for {evaluator}");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

async fn deliver(session: &Session, report: &ScoreReport) -> ScoreReply {
    ask(session, keys::scores(&report.run), Some(encode(report).unwrap())).await.unwrap().unwrap()
}
