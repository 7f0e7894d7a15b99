//! Bytes from the wire are not trusted: whatever strangers send is counted, and the work goes on.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use quad_protocol::{Hash, Job, JobReply, JobRequest, Lease, Name, Schema, ScoreReply, Snapshot, decode, encode, keys};
use quad_tests::made_up::{self, name};
use quad_tests::router::router;
use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http};
use zenoh::Session;

/// Payloads that no receiver may take for a message, derived from a real one.
fn garbage(real: &[u8]) -> Vec<Vec<u8>> {
    let (mut flipped, mut newer) = (real.to_vec(), real.to_vec());
    *flipped.last_mut().unwrap() ^= 1;
    newer[4] ^= 0xff;
    let noise = (0..1000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    vec![
        Vec::new(),
        b"QUAD".to_vec(),
        noise,
        vec![0xff; 100_000],
        real[..real.len() / 2].to_vec(),
        [real, b"more"].concat(),
        flipped,
        newer,
    ]
}

/// A run whose learner answers claims with nonsense of every kind, one after another.
async fn haunt(session: &Session) -> impl Sized {
    let ghost = name("ghost");
    let job = |run: &Name, candidates: u32, environment: &str| {
        let weights = Hash::of(b"no tensors");
        let (run, environment) = (run.clone(), environment.to_owned());
        encode(&JobReply::Job(Job {
            id: 1,
            lease: Lease::random(),
            run,
            incarnation: 1,
            step: 1,
            weights,
            environment,
            instance: 1,
            seeds: vec![1, 2],
            candidates,
            progress_milliseconds: 300,
        }))
        .unwrap()
    };
    let answers = [
        b"QUAD nonsense".to_vec(),
        job(&ghost, 1, "hopper"), // its weights are no safetensors
        job(&ghost, u32::MAX, "hopper"),
        job(&ghost, 1, "moon"),
        job(&name("another"), 1, "hopper"),
    ];
    let schema =
        Schema { environment: "hopper".to_owned(), observation_dim: 11, action_dim: 3, policy: "diffusion".to_owned() };
    let tensors = b"no tensors".to_vec();
    let hash = Hash::of(&tensors);
    let snapshot = encode(&Snapshot { run: ghost.clone(), incarnation: 1, step: 1, schema, hash, tensors }).unwrap();
    let asked = AtomicUsize::new(0);
    let jobs = keys::jobs(&ghost);
    let queryable = session.declare_queryable("quad/ghost/**").callback(move |query| {
        let message = query.payload().map(|payload| payload.to_bytes().into_owned()).unwrap_or_default();
        if matches!(decode(&message), Ok(JobRequest::HandBack { .. })) {
            return;
        }
        let answer = match query.key_expr().as_str() == jobs {
            true => answers[asked.fetch_add(1, Ordering::Relaxed) % answers.len()].clone(),
            false => snapshot.clone(),
        };
        let key = query.key_expr().clone();
        zenoh::Wait::wait(query.reply(key, answer)).unwrap();
    });
    let queryable = queryable.await.unwrap();
    let token = session.liveliness().declare_token(keys::live_learner(&ghost, 1)).await.unwrap();
    let nameless = session.liveliness().declare_token("quad/not a name/live/learner/1").await.unwrap();
    (queryable, token, nameless)
}

#[tokio::test(flavor = "multi_thread")]
async fn nonsense_on_every_key_is_counted_and_survived() {
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let endless = Setting { steps: 100_000_000, eval_interval: 500, ..Setting::default() };
    let mut learner = scratch.learner_with("run", endless, &["--connect", &endpoint]);
    let mut evaluator = scratch.evaluator("brave", &endpoint);
    let first = eventually("there are scores", PATIENCE, || Some(learner.scores().first()?.key().0));

    let run = name("run");
    let replies = session.get(keys::weights_at(&run, first)).await.unwrap();
    let snapshot = replies.recv_async().await.unwrap().into_result().unwrap().payload().to_bytes().into_owned();
    decode::<Snapshot>(&snapshot).unwrap();
    let request = made_up::claim("stranger", 1, "hopper");
    let payloads = garbage(&snapshot).into_iter().chain(garbage(&encode(&request).unwrap()));
    let _ghost = haunt(&session).await;
    for payload in payloads {
        for key in
            ["weights", "weights/1", "weights/x", "jobs", "scores", "scores/1", "progress/x", "live/learner", "x"]
        {
            let key = format!("quad/run/{key}");
            session.put(&key, payload.clone()).await.unwrap();
            session.get(&key).payload(payload.clone()).timeout(Duration::from_secs(1)).await.unwrap();
        }
        // The evaluator keeps only the newest weights: without a pause it would see only the last nonsense.
        tokio::time::sleep(Duration::from_millis(20)).await;
    }

    let evaluator_page = evaluator.metrics();
    for reason in ["hash", "tensors", "job_size", "schema", "other_run"] {
        eventually(&format!("the evaluator counts {reason}"), PATIENCE, || {
            let page = http::metrics(&evaluator_page)?;
            let label = format!("reason=\"{reason}\"");
            (http::sum(&page, "quad_evaluator_rejected_messages_total", &label) > 0.0).then_some(())
        });
    }
    let page = http::metrics(&learner.metrics()).unwrap();
    assert!(http::sum(&page, "quad_learner_rejected_messages_total", "") > 10.0, "{page}");

    let count = learner.scores().len();
    eventually("the evaluator still serves the run", PATIENCE, || {
        (learner.scores().len() > count + 2 * endless.episodes as usize).then_some(())
    });
    assert!(learner.process.is_running() && evaluator.process.is_running());
    let said = evaluator.process.log().matches("ignored what was published as weights").count();
    assert_eq!(said, 1, "bad weights are logged once");
    for (name, log) in [("learner", learner.process.log()), ("evaluator", evaluator.process.log())] {
        assert!(!log.contains("panicked"), "a thread of the {name} panicked:\n{log}");
    }
}

/// Somebody who answers in the learner's place: with messages that are all right but for the incarnation, or never.
async fn impostor(session: &Session, run: &Name) -> impl Sized {
    let tensors = b"other tensors".to_vec();
    let schema =
        Schema { environment: "hopper".to_owned(), observation_dim: 11, action_dim: 3, policy: "diffusion".to_owned() };
    let hash = Hash::of(&tensors);
    let weights = encode(&Snapshot { run: run.clone(), incarnation: 1, step: 20, schema, hash, tensors }).unwrap();
    let wait = encode(&JobReply::Wait { incarnation: 1, milliseconds: 5000 }).unwrap();
    let refused = encode(&ScoreReply::Refused { incarnation: 1, reason: "no".to_owned() }).unwrap();
    let (jobs, scores) = (keys::jobs(run), keys::scores(run));
    let (count, unanswered) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let answer = move |query: zenoh::query::Query| {
        if count.fetch_add(1, Ordering::Relaxed) % 2 == 1 {
            // As long as it is held, nobody knows that there will be no answer.
            unanswered.lock().unwrap().push(query);
            return;
        }
        let key = query.key_expr().clone();
        let message = match key.as_str() {
            key if key == jobs => wait.clone(),
            key if key == scores => refused.clone(),
            _ => weights.clone(),
        };
        zenoh::Wait::wait(query.reply(key, message)).unwrap();
    };
    session.declare_queryable("quad/**").complete(true).callback(answer).await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn whoever_answers_in_the_learners_place_or_never_costs_nothing() {
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let run = name("run");
    let _impostor = impostor(&session, &run).await;
    let setting = Setting { steps: 200, ..Setting::default() };
    let evaluator = scratch.evaluator("loyal", &endpoint);
    let page = evaluator.metrics();
    let start = Instant::now();
    let mut learner = scratch.learner_with("run", setting, &["--connect", &endpoint]);
    let status = learner.process.wait(PATIENCE);
    let took = start.elapsed();
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&setting);
    // Twenty jobs, each claimed and delivered: with five seconds for each question that somebody does not answer, minutes.
    assert!(took < Duration::from_secs(40), "{took:?}");
    let page = http::metrics(&page).unwrap();
    assert!(http::sum(&page, "quad_evaluator_rejected_messages_total", "reason=\"other_incarnation\"") > 3.0, "{page}");
    assert_eq!(http::sum(&page, "quad_evaluator_jobs_total", "outcome=\"abandoned\""), 0.0, "no score was dropped");
}

#[tokio::test(flavor = "multi_thread")]
async fn of_two_learners_under_one_name_the_second_says_so_and_stops() {
    let [one, other] = [Scratch::new(), Scratch::new()];
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let _session = router(&endpoint).await;
    let endless = Setting { steps: 100_000_000, eval_interval: 500, ..Setting::default() };
    let mut first = one.learner_with("run", endless, &["--connect", &endpoint]);
    first.process.wait_for_log("its metrics at", PATIENCE);
    let mut second = other.learner_with("run", endless, &["--connect", &endpoint]);
    let status = second.process.wait(PATIENCE);
    let log = second.process.log();
    assert!(!status.success() && log.contains("there is another learner of run run"), "{status}: {log}");
    assert!(log.contains("hint: choose another name for the folder with --run-dir"), "{log}");
    let _evaluator = one.evaluator("shared", &endpoint);
    eventually("the first is evaluated", PATIENCE, || (!first.scores().is_empty()).then_some(()));
    assert!(first.process.is_running());
}

#[tokio::test(flavor = "multi_thread")]
async fn of_two_learners_under_one_name_that_start_at_once_one_stops() {
    let scratches = [Scratch::new(), Scratch::new()];
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let endless = Setting { steps: 100_000_000, eval_interval: 500, ..Setting::default() };
    let mut learners =
        scratches.each_ref().map(|scratch| scratch.learner_with("run", endless, &["--connect", &endpoint]));
    // Both wait for the router, and so come together.
    std::thread::sleep(Duration::from_secs(2));
    let _session = router(&endpoint).await;
    eventually("one of them stops", PATIENCE, || {
        learners.iter_mut().any(|learner| !learner.process.is_running()).then_some(())
    });
    let _evaluator = scratches[0].evaluator("shared", &endpoint);
    eventually("the other is evaluated", PATIENCE, || {
        learners.iter().any(|learner| !learner.scores().is_empty()).then_some(())
    });
    let running = learners.iter_mut().filter_map(|learner| learner.process.is_running().then_some(())).count();
    assert_eq!(running, 1);
    let said = learners.iter().filter(|learner| learner.process.log().contains("there is another learner")).count();
    assert_eq!(said, 1);
}
