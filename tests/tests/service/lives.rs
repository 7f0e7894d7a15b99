//! An evaluator and the lives of a learner: it follows one, and what it measured for an earlier one is not lost. The learner is
//! made up, so that it can die at the right moment.

use std::sync::{Arc, Mutex};

use quad_protocol::{
    Hash, Job, JobReply, JobRequest, Message, Name, Progress, ScoreReply, ScoreReport, decode, encode, keys,
};
use quad_tests::made_up::{name, snapshot};
use quad_tests::router::router;
use quad_tests::setting::{SHORT, Setting};
use quad_tests::system::{Scratch, free_endpoint};
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
    let setting = Setting { steps: 10, eval_interval: 10, ..SHORT };
    let mut learner = scratch.learner("real", setting);
    eventually("there is a snapshot", PATIENCE, || learner.snapshot(10).exists().then_some(()));
    learner.process.kill();
    std::fs::read(learner.snapshot(10)).unwrap()
}

fn message<M: Message>(payload: Option<&ZBytes>) -> M {
    decode(&payload.unwrap().to_bytes()).unwrap()
}

fn reply<M: Message>(query: &Query, message: &M) {
    query.reply(query.key_expr().clone(), encode(message).unwrap()).wait().unwrap();
}

fn job(run: &Name, incarnation: u64, tensors: &[u8]) -> Job {
    Job {
        id: 1,
        run: run.clone(),
        incarnation,
        step: 10,
        weights: Hash::of(tensors),
        environment: "hopper".to_owned(),
        instance: 1,
        seeds: vec![1, 2, 3],
        candidates: 1,
        progress_milliseconds: 300,
    }
}

/// A life that hands out one job, after it has ignored the first claim.
async fn life(session: &Session, tensors: &[u8], incarnation: u64, heard: &Arc<Mutex<Heard>>) -> impl Sized + use<> {
    let run = name("run");
    let (job, asked) = (job(&run, incarnation, tensors), heard.clone());
    let jobs = session.declare_queryable(keys::jobs(&run)).callback(move |query| {
        let mut heard = asked.lock().unwrap();
        let JobRequest::Claim { attempt, .. } = message(query.payload()) else { return };
        heard.attempts.push(attempt);
        match heard.attempts.len() {
            1 => {}
            2 => reply(&query, &JobReply::Job(job.clone())),
            _ => reply(&query, &JobReply::Wait { incarnation, milliseconds: 100 }),
        }
    });
    let told = heard.clone();
    let scores = session.declare_queryable(keys::scores(&run)).callback(move |query| {
        let report: ScoreReport = message(query.payload());
        let new = report.episodes.len() as u32;
        let mut heard = told.lock().unwrap();
        heard.reports.push(report);
        // What a life says that the evaluator does not follow does not count, though it comes first.
        reply(&query, &ScoreReply::Refused { incarnation: 99, reason: "not mine".to_owned() });
        if heard.acknowledges {
            heard.acknowledged += 1;
            reply(&query, &ScoreReply::Recorded { incarnation, new, duplicates: 0 });
        }
    });
    let answers = [b"other tensors", tensors].map(|tensors| snapshot(&run, incarnation, 10, tensors));
    let weights = session.declare_queryable(keys::weights_at_any_step(&run)).callback(move |query| {
        answers.iter().for_each(|answer| reply(&query, answer));
    });
    let seen = heard.clone();
    let progress = session.declare_subscriber(keys::all_progress(&run)).callback(move |sample| {
        seen.lock().unwrap().progress.push(decode(&sample.payload().to_bytes()).unwrap());
    });
    let declared = (jobs.await.unwrap(), scores.await.unwrap(), weights.await.unwrap(), progress.await.unwrap());
    (declared, session.liveliness().declare_token(keys::live_learner(&run, incarnation)).await.unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn scores_measured_for_one_life_are_delivered_to_the_next() {
    let scratch = Scratch::new();
    let tensors = tensors(&scratch);
    let endpoint = free_endpoint();
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
    assert_eq!((jobs("scored"), jobs("abandoned")), (0.0, 0.0), "what another life refuses is kept");

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
    let endpoint = free_endpoint();
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
