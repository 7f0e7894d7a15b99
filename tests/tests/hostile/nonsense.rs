//! Bytes from the wire are not trusted: what cannot be understood is counted, and the work
//! continues.

use std::time::Duration;

use quad_protocol::{JobReply, JobRequest, Snapshot, decode, encode, keys};
use quad_tests::made_up::{self, name};
use quad_tests::router::router;
use quad_tests::setting::ENDLESS;
use quad_tests::system::{Scratch, free_endpoint};
use quad_tests::{PATIENCE, eventually, http};
use zenoh::Session;
use zenoh::qos::CongestionControl;

const KEYS: &str = "weights weights/1 weights/x jobs scores experience progress/x live/learner x";

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

/// Sends each payload on every key of a run.
async fn send_everywhere(session: &Session, payloads: impl Iterator<Item = Vec<u8>>) {
    for payload in payloads {
        for key in KEYS.split(' ') {
            let key = format!("quad/run/{key}");
            // A busy machine would else drop some.
            let put = session.put(&key, payload.clone());
            put.congestion_control(CongestionControl::Block).await.unwrap();
            let get = session.get(&key).payload(payload.clone());
            get.timeout(Duration::from_secs(1)).await.unwrap();
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn nonsense_on_every_key_is_counted_and_survived() {
    let scratch = Scratch::new();
    let endpoint = free_endpoint();
    let session = router(&endpoint).await;
    let mut learner = scratch.learner_with("run", ENDLESS, &["--connect", &endpoint]);
    let mut evaluator = scratch.evaluator("brave", &endpoint);
    let first = eventually("there are scores", PATIENCE, || Some(learner.scores().first()?.step));

    let run = name("run");
    let replies = session.get(keys::weights_at(&run, first)).await.unwrap();
    let reply = replies.recv_async().await.unwrap().into_result().unwrap();
    let snapshot = reply.payload().to_bytes();
    let mut earlier: Snapshot = decode(&snapshot).unwrap();
    earlier.incarnation -= 1;
    let put = session.put(keys::weights(&run), encode(&earlier).unwrap());
    put.congestion_control(CongestionControl::Block).await.unwrap();
    let evaluator_page = evaluator.metrics();
    let count_of = |reason: &str| {
        let page = http::metrics(&evaluator_page)?;
        let label = format!("reason=\"{reason}\"");
        let count = http::sum(&page, "quad_evaluator_rejected_messages_total", &label);
        (count > 0.0).then_some(())
    };
    eventually("the evaluator counts weights of another learner process", PATIENCE, || {
        count_of("other_incarnation")
    });

    let request = made_up::claim("client", 1, "hopper");
    let payloads = garbage(&snapshot).into_iter().chain(garbage(&encode(&request).unwrap()));
    send_everywhere(&session, payloads).await;

    eventually("the evaluator counts weights that are not what they say", PATIENCE, || {
        count_of("hash")
    });
    for reason in ["empty", "not_quad", "version", "truncated", "oversized", "kind"] {
        let label = format!("reason=\"{reason}\"");
        learner.wait_for_metric("rejected_messages_total", &label, |count| count > 0.0);
    }
    const OLD: &str = "an evaluator gets no job: the message has protocol version";
    learner.process.wait_for_log(OLD, PATIENCE);
    assert_eq!(learner.process.log().matches(OLD).count(), 1, "it is told once");

    let count = learner.scores().len();
    learner.wait_for_scores(count + 2 * ENDLESS.episodes as usize);
    assert!(learner.process.is_running() && evaluator.process.is_running());
    let said = evaluator.process.log().matches("ignored a bad snapshot").count();
    assert_eq!(said, 1, "bad weights are logged once");
    evaluator.process.assert_not_said("another learner process");
    learner.process.assert_not_said("panicked");
    evaluator.process.assert_not_said("panicked");
}

#[tokio::test(flavor = "multi_thread")]
async fn failed_jobs_are_logged_once_and_shortened() {
    let scratch = Scratch::new();
    let learner = scratch.learner("run", ENDLESS);
    let (session, run) = (made_up::client(&learner.endpoint()).await, name("run"));
    for evaluator in ["a", "b"] {
        let job = made_up::claim_eventually(&session, &run, evaluator).await;
        let reason =
            format!("the policy\u{1b}[2J cannot act, says {evaluator}\n{}", "x".repeat(10_000));
        let request =
            JobRequest::HandBack { evaluator: name(evaluator), job: job.id, failed: Some(reason) };
        let reply = made_up::ask(&session, keys::jobs(&run), &request).await;
        assert!(matches!(reply, Some(JobReply::HandedBack { accepted: true, .. })), "{reply:?}");
    }
    learner.wait_for_metric("jobs_total", "outcome=\"failed\"", |failed| failed == 2.0);
    let said = learner.process.wait_for_log("could not do a job", PATIENCE);
    let (_, reason) = said.split_once("which goes to others: ").unwrap();
    assert!(reason.starts_with("the policy[2J cannot act, says axxx"), "{said}");
    assert_eq!(reason.len(), 300, "{said}");
    let count = learner.process.log().matches("could not do a job").count();
    assert_eq!(count, 1, "the second is not told");
}
