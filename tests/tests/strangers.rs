//! Bytes from the wire are not trusted: whatever strangers send is counted, and the work goes on.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use quad_protocol::{Hash, Job, JobReply, JobRequest, Lease, Name, Schema, Snapshot, decode, encode, keys};
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

fn claim(evaluator: &str, attempt: u64) -> JobRequest {
    let (evaluator, precision) = (Name::new(evaluator).unwrap(), Name::new("f32").unwrap());
    JobRequest::Claim { evaluator, attempt, environments: vec!["hopper".to_owned()], precision }
}

/// A run whose learner answers claims with nonsense of every kind, one after another.
async fn haunt(session: &Session) -> impl Sized {
    let ghost = Name::new("ghost").unwrap();
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
            lease_milliseconds: 1000,
        }))
        .unwrap()
    };
    let answers = [
        b"QUAD nonsense".to_vec(),
        job(&ghost, 1, "hopper"), // its weights are no safetensors
        job(&ghost, u32::MAX, "hopper"),
        job(&ghost, 1, "moon"),
        job(&Name::new("another").unwrap(), 1, "hopper"),
    ];
    let schema =
        Schema { environment: "hopper".to_owned(), observation_dim: 11, action_dim: 3, policy: "diffusion".to_owned() };
    let tensors = b"no tensors".to_vec();
    let hash = Hash::of(&tensors);
    let snapshot = encode(&Snapshot { run: ghost.clone(), incarnation: 1, step: 1, schema, hash, tensors }).unwrap();
    let asked = AtomicUsize::new(0);
    let jobs = keys::jobs(&ghost);
    let queryable = session.declare_queryable("quad/ghost/**").callback(move |query| {
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

    let run = Name::new("run").unwrap();
    let replies = session.get(keys::weights_at(&run, first)).await.unwrap();
    let snapshot = replies.recv_async().await.unwrap().into_result().unwrap().payload().to_bytes().into_owned();
    decode::<Snapshot>(&snapshot).unwrap();
    let request = claim("stranger", 1);
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
    for (name, log) in [("learner", learner.process.log()), ("evaluator", evaluator.process.log())] {
        assert!(!log.contains("panicked"), "a thread of the {name} panicked:\n{log}");
    }
}
