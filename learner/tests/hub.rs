//! The learner's side of the wire, spoken to by made-up evaluators over TCP.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::collections::{BTreeMap, HashMap};
use std::net::TcpListener;
use std::time::{Duration, Instant};

use quad_learner::hub::{self, EvaluationPlan, Hub, Logs};
use quad_learner::inbox::{Inbox, inbox};
use quad_learner::metrics::Metrics;
use quad_learner::notice::Notice;
use quad_learner::publisher::{self, Identity, Kept, SnapshotPublisher};
use quad_learner::run_dir::RunDir;
use quad_learner::scoreboard::{Rules, Scoreboard};
use quad_learner::wire::{Life, Wire};
use quad_protocol::{
    CannotAct, EpisodeScore, Hash, Job, JobReply, JobRequest, Lease, Message, Name, Origin, Progress, RecordedScores,
    ScoreReply, ScoreReport, Snapshot, WeightsRequest, decode, encode, keys,
};
use quad_service::{Beat, Endpoints, Health, open_session};
use safetensors::Dtype;
use safetensors::tensor::TensorView;
use tokio::sync::mpsc::UnboundedReceiver;
use zenoh::Session;

const PATIENCE: Duration = Duration::from_secs(20);
const LEASE: Duration = Duration::from_millis(800);
const INCARNATION: u64 = 5;

/// A learner without training: its threads, its declarations, its folder.
struct Bench {
    run: Name,
    run_dir: RunDir,
    endpoint: String,
    metrics: Metrics,
    notices: UnboundedReceiver<Notice>,
    publisher: Inbox<publisher::Event>,
    hub: Inbox<hub::Event>,
    _wire: Wire,
    _folder: tempfile::TempDir,
}

fn beat() -> Beat {
    Health::default().part("a thread", PATIENCE)
}

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

fn tensors(step: u64) -> Vec<u8> {
    let bytes = vec![step as u8; 1_000_000];
    let tensor = TensorView::new(Dtype::U8, vec![bytes.len()], &bytes).unwrap();
    let shape = "{\"kind\":\"gaussian\",\"observation_dim\":11,\"action_dim\":3,\"hidden\":8}";
    let metadata = HashMap::from([("policy".to_owned(), shape.to_owned())]);
    safetensors::serialize([("weights", tensor)], Some(metadata)).unwrap()
}

/// The file that is published of them.
fn file(step: u64) -> Vec<u8> {
    let origin = Origin { environment: "hopper".to_owned(), seed: 1, step, episodes: 4, candidates: 3 };
    origin.attach(&tensors(step)).unwrap()
}

impl Bench {
    /// Jobs of two episodes, four episodes per evaluation.
    async fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let run = name("bench");
        let run_dir = RunDir::create(&folder.path().join("bench"), &config()).unwrap();
        let (metrics, _) = Metrics::new(&run, 100, &[]).unwrap();
        let (notify, notices) = tokio::sync::mpsc::unbounded_channel();
        let task = quad_dataset::Task::from(quad_dataset::environment::find("hopper").unwrap());
        let rules = Rules {
            run: run.clone(),
            incarnation: INCARNATION,
            task: task.clone(),
            instance: 1,
            candidates: 3,
            job_episodes: 2,
            lease: LEASE,
            audit: 0.0,
        };
        let plan = EvaluationPlan { seed: 1, episodes: 4 };
        let logs = Logs { scores: run_dir.score_log().unwrap(), audits: None };
        let state = Hub::new(run.clone(), plan, Scoreboard::new(rules), logs, metrics.clone(), notify.clone());
        let (hub, messages) = inbox();
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
        let life = Life { run: run.clone(), incarnation: INCARNATION };
        let wire = Wire::declare(session, life, &hub, &publisher, &metrics, || Ok(())).await.unwrap();
        Self { run, run_dir, endpoint, metrics, notices, publisher, hub, _wire: wire, _folder: folder }
    }

    async fn client(&self) -> Session {
        open_session(&Endpoints { connect: vec![self.endpoint.clone()], ..Endpoints::default() }).await.unwrap()
    }

    async fn snapshot(&mut self, step: u64) {
        let tensors = file(step);
        self.run_dir.write_snapshot(step, &tensors).unwrap();
        let kept = Kept { step, kind: "diffusion", hash: Hash::of(&tensors), tensors };
        self.publisher.send(publisher::Event::Kept(kept));
        self.until(|notice| matches!(notice, Notice::Published { step: published } if *published == step)).await;
    }

    async fn until(&mut self, wanted: impl Fn(&Notice) -> bool) -> Notice {
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

    fn rejected(&self, reason: &str) -> u64 {
        self.metrics.rejected.with_label_values(&[reason]).get()
    }

    fn lines(&self) -> usize {
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
async fn ask<A: Message>(session: &Session, key: String, payload: Option<Vec<u8>>) -> Option<Result<A, String>> {
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

fn claim_message(evaluator: &str, attempt: u64) -> JobRequest {
    JobRequest::Claim {
        evaluator: name(evaluator),
        attempt,
        environments: vec!["hopper".into()],
        precision: name("f32"),
    }
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

fn report(job: &Job, evaluator: &str) -> ScoreReport {
    let hopper = quad_dataset::environment::find("hopper").unwrap();
    let episode =
        |&seed| EpisodeScore { seed, episode_return: 1000.0, length: 300, score: hopper.normalised_score(1000.0) };
    let Job { run, incarnation, step, weights, .. } = job.clone();
    let episodes = job.seeds.iter().map(episode).collect();
    ScoreReport {
        evaluator: name(evaluator),
        run,
        incarnation,
        job: job.id,
        step,
        weights,
        precision: name("f32"),
        episodes,
        cannot_act: None,
    }
}

fn progress(job: &Job, evaluator: &str, steps_done: u64) -> Progress {
    Progress {
        evaluator: name(evaluator),
        run: job.run.clone(),
        incarnation: job.incarnation,
        job: job.id,
        step: job.step,
        episodes_done: 0,
        episodes_total: 2,
        steps_done,
        environment_steps: 40,
        episodes: 1,
        proof: Hash::of(b"none"),
    }
    .signed(&job.lease)
}

async fn deliver(session: &Session, report: &ScoreReport) -> ScoreReply {
    ask(session, keys::scores(&report.run), Some(encode(report).unwrap())).await.unwrap().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_policy_that_cannot_act_ends_the_run_with_the_reason() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    bench.snapshot(1000).await;
    let job = claim_eventually(&client, &bench.run, "a").await;
    let reason = "a value of a candidate is not a number (NaN)".to_owned();
    let complaint = CannotAct::signed(reason, job.weights, &job.lease);
    let forged = CannotAct { proof: Hash::of(b"guessed"), ..complaint.clone() };
    let broken = ScoreReport { episodes: Vec::new(), cannot_act: Some(complaint), ..report(&job, "a") };
    let stranger = ScoreReport { cannot_act: Some(forged), ..broken.clone() };
    assert!(matches!(deliver(&client, &stranger).await, ScoreReply::Refused { .. }), "it has not the job's lease");
    assert_eq!(bench.rejected("wrong_proof"), 1);
    deliver(&client, &broken).await;
    bench.until(|notice| matches!(notice, Notice::Failed(error) if error.to_string().contains("step 1000 cannot act: a value")))
        .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_goes_out_and_its_scores_are_on_disk_before_the_thanks() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    let watched = client.declare_subscriber(keys::scores_at(&bench.run, 10)).await.unwrap();
    bench.snapshot(10).await;

    let job = claim_eventually(&client, &bench.run, "a").await;
    assert_eq!((job.step, job.incarnation, job.candidates, job.seeds.len()), (10, INCARNATION, 3, 2));
    assert_eq!(job.weights, Hash::of(&file(10)));

    let recorded = deliver(&client, &report(&job, "a")).await;
    assert_eq!(bench.lines(), 2);
    assert!(matches!(recorded, ScoreReply::Recorded { incarnation: INCARNATION, new: 2, duplicates: 0 }));
    let again = deliver(&client, &report(&job, "a")).await;
    assert!(matches!(again, ScoreReply::Recorded { new: 0, duplicates: 2, .. }));
    assert_eq!((bench.lines(), bench.metrics.evaluation.scores_duplicate.get()), (2, 2));

    let sample = tokio::time::timeout(PATIENCE, watched.recv_async()).await.unwrap().unwrap();
    let published: RecordedScores = decode(&sample.payload().to_bytes()).unwrap();
    assert_eq!((published.step, published.episodes.len(), published.evaluator), (10, 2, name("a")));

    let rest = claim_eventually(&client, &bench.run, "a").await;
    deliver(&client, &report(&rest, "a")).await;
    let Notice::Evaluated { step: 10, scores } = bench.until(|notice| matches!(notice, Notice::Evaluated { .. })).await
    else {
        panic!("another step")
    };
    assert_eq!(scores.len(), 4);
    assert_eq!(bench.metrics.evaluation.step.get(), 10);
    bench.publisher.send(publisher::Event::TrainingCompleted);
    bench.until(|notice| matches!(notice, Notice::Settled)).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn weights_are_published_and_older_ones_are_answered_from_the_disk() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    let published = client.declare_subscriber(keys::weights(&bench.run)).await.unwrap();
    tokio::time::sleep(Duration::from_millis(200)).await; // the learner learns of the subscription
    bench.snapshot(10).await;
    let sample = tokio::time::timeout(PATIENCE, published.recv_async()).await.unwrap().unwrap();
    assert_eq!(decode::<Snapshot>(&sample.payload().to_bytes()).unwrap().step, 10);
    bench.snapshot(20).await;
    for step in [10, 20] {
        let snapshot: Snapshot = ask(&client, keys::weights_at(&bench.run, step), None).await.unwrap().unwrap();
        assert_eq!((snapshot.step, snapshot.hash, snapshot.tensors), (step, Hash::of(&file(step)), file(step)));
    }
    let missing = ask::<Snapshot>(&client, keys::weights_at(&bench.run, 11), None).await.unwrap();
    assert!(missing.unwrap_err().contains("no snapshot"));

    let path = bench.run_dir.path().join("snapshots/step_000000010.safetensors");
    std::fs::write(path, "something else").unwrap();
    let changed = ask::<Snapshot>(&client, keys::weights_at(&bench.run, 10), None).await.unwrap();
    assert!(changed.unwrap_err().contains("was changed"));
}

#[tokio::test(flavor = "multi_thread")]
async fn garbage_is_counted_by_reason_and_answered_with_an_error() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    let good = encode(&claim_message("a", 1)).unwrap();
    let mut newer = good.clone();
    newer[4] ^= 0xff;
    for key in [keys::jobs(&bench.run), keys::scores(&bench.run)] {
        for payload in [None, Some(b"GET / HTTP/1.1".to_vec()), Some(newer.clone()), Some(good[..9].to_vec())] {
            assert!(ask::<JobReply>(&client, key.clone(), payload).await.unwrap().is_err());
        }
        assert!(ask::<JobReply>(&client, key, Some(vec![0; 1 << 20])).await.unwrap().is_err());
    }
    let wrong_kind = ask::<ScoreReply>(&client, keys::scores(&bench.run), Some(good.clone())).await.unwrap();
    assert!(wrong_kind.is_err());
    client.put(keys::progress(&bench.run, &name("a")), "nonsense").await.unwrap();
    for reason in ["empty", "not_quad", "version", "truncated", "oversized", "kind"] {
        assert!(bench.rejected(reason) > 0, "{reason} is not counted");
    }

    let job = claim_eventually(&client, &bench.run, "a").await;
    let wrong = ScoreReport { weights: Hash::of(b"others"), ..report(&job, "a") };
    let ScoreReply::Refused { reason, .. } = deliver(&client, &wrong).await else { panic!("accepted") };
    assert!(reason.contains("other weights"), "{reason}");
    assert_eq!((bench.rejected("unknown_weights"), bench.lines()), (1, 0));
    assert!(matches!(deliver(&client, &report(&job, "a")).await, ScoreReply::Recorded { new: 2, .. }));
}

#[tokio::test(flavor = "multi_thread")]
async fn jobs_of_evaluators_that_die_or_fall_silent_go_to_others() {
    let mut bench = Bench::start().await;
    bench.snapshot(10).await;

    let mortal = bench.client().await;
    let _token = mortal.liveliness().declare_token(keys::live_evaluator(&bench.run, &name("mortal"))).await.unwrap();
    bench.until(|notice| matches!(notice, Notice::EvaluatorJoined(who) if *who == name("mortal"))).await;
    assert_eq!(bench.metrics.evaluators.present.get(), 1);
    let lost = claim_eventually(&mortal, &bench.run, "mortal").await;
    mortal.close().await.unwrap();
    let left = bench.until(|notice| matches!(notice, Notice::EvaluatorLeft(..))).await;
    assert!(matches!(left, Notice::EvaluatorLeft(_, 1)), "{left:?}");

    // Without a token only the lease tells; progress holds it up.
    let client = bench.client().await;
    let silent = claim_eventually(&client, &bench.run, "silent").await;
    assert_eq!(silent.seeds, lost.seeds);
    let working = claim_eventually(&client, &bench.run, "working").await;
    assert!(claim(&client, &bench.run, "a").await.is_none());
    let start = Instant::now();
    let mut steps = 0;
    let again = loop {
        steps += 1;
        let message = encode(&progress(&working, "working", steps)).unwrap();
        client.put(keys::progress(&bench.run, &name("working")), message).await.unwrap();
        if let Some(job) = claim(&client, &bench.run, "a").await {
            break job;
        }
        assert!(start.elapsed() < PATIENCE);
        tokio::time::sleep(LEASE / 8).await;
    };
    assert_eq!(again.seeds, silent.seeds);
    assert!(start.elapsed() >= LEASE / 2, "the lease was respected");
    assert_eq!(bench.metrics.evaluation.jobs_expired.get(), 2);

    for (job, evaluator) in [(&again, "a"), (&working, "working"), (&silent, "silent")] {
        deliver(&client, &report(job, evaluator)).await;
    }
    assert_eq!((bench.lines(), bench.metrics.evaluation.scores_duplicate.get()), (4, 2));
    bench.hub.send(hub::Event::TrainingCompleted);
    bench.until(|notice| matches!(notice, Notice::Settled)).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_claim_is_answered_twice_with_one_job_which_can_be_handed_back() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    let job = claim_eventually(&client, &bench.run, "a").await;
    assert_eq!(claim(&client, &bench.run, "a").await.as_ref(), Some(&job));
    assert_eq!(bench.metrics.evaluation.jobs_handed_out.get(), 1);
    let other = ask_for_job(&client, &bench.run, &claim_message("a", 2)).await;
    assert!(matches!(other, JobReply::Wait { incarnation: INCARNATION, .. }), "{other:?}");

    let hand_back = |lease| JobRequest::HandBack { evaluator: name("a"), job: job.id, lease };
    for (lease, expected) in [(Lease::random(), false), (job.lease.clone(), true), (job.lease.clone(), false)] {
        let reply = ask_for_job(&client, &bench.run, &hand_back(lease)).await;
        assert!(matches!(reply, JobReply::HandedBack { accepted, .. } if accepted == expected), "{reply:?}");
    }
    assert_eq!(bench.metrics.evaluation.jobs_handed_back.get(), 1);
    assert_eq!(claim_eventually(&client, &bench.run, "b").await.seeds, job.seeds);
}

#[tokio::test(flavor = "multi_thread")]
async fn progress_that_was_heard_or_guessed_does_not_hold_a_job() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    let job = claim_eventually(&client, &bench.run, "a").await;
    let heard = progress(&job, "a", 10);
    let guessed = Progress { steps_done: 1 << 40, ..heard.clone() };
    let start = Instant::now();
    while bench.metrics.evaluation.jobs_expired.get() == 0 {
        for message in [&heard, &guessed] {
            client.put(keys::progress(&bench.run, &name("a")), encode(message).unwrap()).await.unwrap();
        }
        assert!(start.elapsed() < PATIENCE, "the lease never ends");
        tokio::time::sleep(LEASE / 20).await;
    }
    assert!(bench.rejected("wrong_proof") > 5 && bench.rejected("not_advanced") > 5);
}

/// Asks for weights again and again, and then reads nothing: the process stops itself.
async fn reads_nothing(endpoint: String) {
    let endpoints = Endpoints { connect: vec![endpoint], ..Endpoints::default() };
    let session = open_session(&endpoints).await.unwrap();
    for _ in 0..150 {
        let key = keys::weights_at(&name("bench"), 10);
        session.get(key).timeout(PATIENCE).callback(drop).await.unwrap();
    }
    let stop = format!("kill -STOP {}", std::process::id());
    std::process::Command::new("sh").args(["-c", &stop]).status().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_peer_that_reads_nothing_holds_up_neither_jobs_nor_snapshots() {
    const STRANGER: &str = "QUAD_TEST_STRANGER";
    if let Ok(endpoint) = std::env::var(STRANGER) {
        return reads_nothing(endpoint).await;
    }
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    let mut command = std::process::Command::new(std::env::current_exe().unwrap());
    command
        .args(["--exact", "a_peer_that_reads_nothing_holds_up_neither_jobs_nor_snapshots"])
        .env(STRANGER, &bench.endpoint);
    let mut stranger = command.stdout(std::process::Stdio::null()).spawn().unwrap();
    let state = || std::fs::read_to_string(format!("/proc/{}/stat", stranger.id())).unwrap();
    let start = Instant::now();
    while !state().contains(") T ") {
        assert!(start.elapsed() < PATIENCE, "{}", state());
        tokio::time::sleep(Duration::from_millis(5)).await;
    }

    let request = encode(&WeightsRequest { evaluator: name("a") }).unwrap();
    // As long as Zenoh has not noticed. To close the connection, it lets all others wait for whoever still sends.
    let (start, mut slowest, mut step) = (Instant::now(), Duration::ZERO, 10);
    while start.elapsed() < Duration::from_secs(3) {
        let asked = Instant::now();
        claim(&client, &bench.run, "a").await.expect("always the same job");
        step += 10;
        bench.snapshot(step).await;
        let snapshot: Snapshot =
            ask(&client, keys::weights_at(&bench.run, step), Some(request.clone())).await.unwrap().unwrap();
        assert_eq!(snapshot.step, step);
        slowest = slowest.max(asked.elapsed());
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    stranger.kill().unwrap();
    stranger.wait().unwrap();
    // A snapshot is published with some patience for each subscriber, and there are other tests beside this one.
    assert!(slowest < Duration::from_secs(2), "{slowest:?}");
}
