//! An evaluator and the lives of a learner: it follows one, and what it measured for an earlier one is not lost. The learner is
//! made up, so that it can die at the right moment.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::{Arc, Mutex};

use quad_protocol::{
    Hash, Job, JobReply, JobRequest, Lease, Name, Progress, Schema, ScoreReply, ScoreReport, Snapshot, decode, encode,
    keys,
};
use quad_tests::router::router;
use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http};
use zenoh::bytes::ZBytes;
use zenoh::query::Query;
use zenoh::{Session, Wait};

/// What an evaluator has sent, and what becomes of it.
#[derive(Default)]
struct Heard {
    attempts: Vec<u64>,
    progress: Vec<Progress>,
    reports: Vec<ScoreReport>,
    /// Whether lives acknowledge reports, and how many they have.
    acknowledges: bool,
    acknowledged: usize,
}

/// The weights of a real learner.
fn tensors(scratch: &Scratch) -> Vec<u8> {
    let setting = Setting { steps: 10, eval_interval: 10, ..Setting::default() };
    let mut learner = scratch.learner("real", setting);
    eventually("there is a snapshot", PATIENCE, || learner.snapshot(10).exists().then_some(()));
    learner.process.kill();
    std::fs::read(learner.snapshot(10)).unwrap()
}

fn snapshot(tensors: &[u8], incarnation: u64) -> Snapshot {
    let schema =
        Schema { environment: "hopper".to_owned(), observation_dim: 11, action_dim: 3, policy: "diffusion".to_owned() };
    let (run, hash, tensors) = (Name::new("run").unwrap(), Hash::of(tensors), tensors.to_vec());
    Snapshot { run, incarnation, step: 10, schema, hash, tensors }
}

fn message<M: quad_protocol::Message>(payload: Option<&ZBytes>) -> M {
    decode(&payload.unwrap().to_bytes()).unwrap()
}

fn reply<M: quad_protocol::Message>(query: &Query, message: &M) {
    query.reply(query.key_expr().clone(), encode(message).unwrap()).wait().unwrap();
}

/// A life that hands out one job, after it has ignored the first claim.
async fn life(session: &Session, tensors: &[u8], incarnation: u64, heard: &Arc<Mutex<Heard>>) -> impl Sized + use<> {
    let run = Name::new("run").unwrap();
    let weights = snapshot(tensors, incarnation);
    let job = Job {
        id: 1,
        lease: Lease::random(),
        run: run.clone(),
        incarnation,
        step: 10,
        weights: weights.hash,
        environment: "hopper".to_owned(),
        instance: 1,
        seeds: vec![1, 2, 3],
        candidates: 1,
        progress_milliseconds: 300,
    };
    let (heard_jobs, lease) = (heard.clone(), job.lease.clone());
    let jobs = session.declare_queryable(keys::jobs(&run)).callback(move |query| {
        let mut heard = heard_jobs.lock().unwrap();
        let JobRequest::Claim { attempt, .. } = message(query.payload()) else { return };
        heard.attempts.push(attempt);
        match heard.attempts.len() {
            1 => {}
            2 => reply(&query, &JobReply::Job(job.clone())),
            _ => reply(&query, &JobReply::Wait { incarnation, milliseconds: 100 }),
        }
    });
    let heard_scores = heard.clone();
    let scores = session.declare_queryable(keys::scores(&run)).callback(move |query| {
        let report: ScoreReport = message(query.payload());
        let new = report.episodes.len() as u32;
        let mut heard = heard_scores.lock().unwrap();
        heard.reports.push(report);
        // What a life says that nobody follows does not count, though it comes first.
        reply(&query, &ScoreReply::Refused { incarnation: 99, reason: "not mine".to_owned() });
        if heard.acknowledges {
            heard.acknowledged += 1;
            reply(&query, &ScoreReply::Recorded { incarnation, new, duplicates: 0 });
        }
    });
    let weights = session.declare_queryable(keys::weights_at_any_step(&run)).callback(move |query| {
        reply(&query, &snapshot(b"other tensors", incarnation));
        reply(&query, &weights);
    });
    let heard_progress = heard.clone();
    let progress = session.declare_subscriber(keys::all_progress(&run)).callback(move |sample| {
        let progress: Progress = decode(&sample.payload().to_bytes()).unwrap();
        assert!(progress.is_signed(&lease), "{progress:?}");
        heard_progress.lock().unwrap().progress.push(progress);
    });
    let declared = (jobs.await.unwrap(), scores.await.unwrap(), weights.await.unwrap(), progress.await.unwrap());
    (declared, session.liveliness().declare_token(keys::live_learner(&run, incarnation)).await.unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn scores_measured_for_one_life_are_delivered_to_the_next() {
    let scratch = Scratch::new();
    let tensors = tensors(&scratch);
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let heard = Arc::new(Mutex::new(Heard::default()));
    let first = life(&session, &tensors, 5, &heard).await;
    let evaluator = scratch.evaluator("patient", &endpoint);
    eventually("scores are delivered, and not acknowledged", PATIENCE, || {
        (!heard.lock().unwrap().reports.is_empty()).then_some(())
    });
    {
        let heard = heard.lock().unwrap();
        assert_eq!(heard.attempts[0], heard.attempts[1], "a claim without an answer is the same claim again");
        assert!(heard.progress.first().is_some_and(|first| first.steps_done == 0), "{:?}", heard.progress);
        assert!(heard.progress.windows(2).all(|two| two[0].steps_done <= two[1].steps_done));
    }
    let page = evaluator.metrics();
    let jobs = |outcome: &str| {
        let label = format!("outcome=\"{outcome}\"");
        http::sum(&http::metrics(&page).unwrap(), "quad_evaluator_jobs_total", &label)
    };
    assert_eq!((jobs("scored"), jobs("abandoned")), (0.0, 0.0), "what a stranger refuses is kept");

    drop(first);
    let count = heard.lock().unwrap().reports.len();
    heard.lock().unwrap().acknowledges = true;
    let _second = life(&session, &tensors, 6, &heard).await;
    eventually("the next life has the scores", PATIENCE, || (jobs("scored") == 1.0).then_some(()));
    let heard = heard.lock().unwrap();
    assert!(heard.reports.len() > count);
    let report = heard.reports.last().unwrap();
    assert_eq!((report.incarnation, report.step, report.weights), (5, 10, Hash::of(&tensors)));
    assert_eq!(report.episodes.iter().map(|episode| episode.seed).collect::<Vec<_>>(), [1, 2, 3]);
    let attempts = &heard.attempts;
    assert!(attempts[2..].iter().all(|attempt| *attempt != attempts[0]), "another claim has another number");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_evaluator_that_leaves_delivers_what_was_not_acknowledged() {
    let scratch = Scratch::new();
    let tensors = tensors(&scratch);
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let heard = Arc::new(Mutex::new(Heard::default()));
    let _life = life(&session, &tensors, 5, &heard).await;
    let mut evaluator = scratch.evaluator("leaving", &endpoint);
    // By then it tries again every four or five seconds.
    eventually("scores are delivered again and again", PATIENCE, || {
        (heard.lock().unwrap().reports.len() >= 5).then_some(())
    });
    heard.lock().unwrap().acknowledges = true;
    evaluator.process.terminate(PATIENCE);
    assert_eq!(heard.lock().unwrap().acknowledged, 1);
}
