//! Rights of each role: at the router as it is shipped, and at a learner that listens itself.

use std::time::{Duration, Instant};

use quad_tests::certificates::{Certificates, come_in};
use quad_tests::router::protected_router;
use quad_tests::setting::ENDLESS;
use quad_tests::system::Scratch;
use quad_tests::{PATIENCE, eventually};
use tokio::time::{sleep, timeout};
use zenoh::Session;
use zenoh::handlers::FifoChannelHandler;
use zenoh::pubsub::Subscriber;
use zenoh::qos::CongestionControl;
use zenoh::query::{Query, Queryable};
use zenoh::sample::Sample;

use crate::access::HOST;

/// For what must not happen.
const LULL: Duration = Duration::from_millis(500);
/// A message that only shows whether messages arrive.
const PROBE: &str = "probe";

/// Sessions with the certificates of those roles at the shipped router, which stays as long as the
/// first part.
async fn at_the_router<const N: usize>(roles: [&str; N]) -> Option<(impl Sized, [Session; N])> {
    let certificates = Certificates::make()?;
    let (router, endpoint) = protected_router(HOST, &certificates.of("router")).await;
    let mut sessions = Vec::new();
    for role in roles {
        sessions.push(come_in(&endpoint, &certificates.of("router"), &certificates.of(role)).await);
    }
    Some(((router, certificates), sessions.try_into().unwrap()))
}

/// The key that arrives next.
async fn next(samples: &Subscriber<FifoChannelHandler<Sample>>) -> String {
    loop {
        let sample = timeout(PATIENCE, samples.recv_async()).await;
        let sample = sample.expect("nothing arrives").unwrap();
        if *sample.payload().to_bytes() != *PROBE.as_bytes() {
            return sample.key_expr().to_string();
        }
    }
}

/// Sends once, where a busy machine would else drop it.
async fn put(session: &Session, key: &str) {
    session.put(key, "words").congestion_control(CongestionControl::Block).await.unwrap();
}

/// Sends until it arrives: before, the router does not know of those who listen.
async fn reach(from: &Session, key: &str, samples: &Subscriber<FifoChannelHandler<Sample>>) {
    let deadline = Instant::now() + PATIENCE;
    loop {
        from.put(key, PROBE).await.unwrap();
        match samples.recv_timeout(LULL).unwrap() {
            Some(sample) if sample.key_expr().as_str() == key => return,
            _ => assert!(Instant::now() < deadline, "{key} does not arrive"),
        }
    }
}

/// The keys that arrive until `last` does.
async fn until(samples: &Subscriber<FifoChannelHandler<Sample>>, last: &str) -> Vec<String> {
    let mut keys = Vec::new();
    while keys.last().map(String::as_str) != Some(last) {
        keys.push(next(samples).await);
    }
    keys
}

/// Answers every question.
async fn answer(session: &Session, key: &str) -> Queryable<()> {
    let callback = |query: Query| {
        zenoh::Wait::wait(query.reply(query.key_expr().clone(), "an answer")).ok();
    };
    session.declare_queryable(key).callback(callback).await.unwrap()
}

/// Number of answers.
async fn answers(session: &Session, key: &str) -> usize {
    let replies = session.get(key).timeout(LULL).await.unwrap();
    let mut count = 0;
    while let Ok(reply) = replies.recv_async().await {
        count += usize::from(reply.result().is_ok());
    }
    count
}

#[tokio::test(flavor = "multi_thread")]
async fn only_learners_publish_weights_and_only_evaluators_report_progress() {
    let roles = ["learner", "evaluator", "monitor", "monitor", "evaluator"];
    let Some((_router, sessions)) = at_the_router(roles).await else { return };
    let [learner, evaluator, monitor, listener, receiver] = sessions;
    let heard = listener.declare_subscriber("quad/run/**").await.unwrap();
    let weights = receiver.declare_subscriber("quad/run/weights").await.unwrap();
    let spied = receiver.declare_subscriber("quad/run/progress/*").await.unwrap();
    reach(&evaluator, "quad/run/progress/e", &heard).await;
    for samples in [&heard, &weights] {
        reach(&learner, "quad/run/weights", samples).await;
    }
    // A session hears itself whatever it may do, so listener and receiver put nothing.
    for key in ["progress/e", "jobs", "scores", "weights/1", "live/learner", "*", "**", "weights"] {
        for session in [&monitor, &evaluator, &learner] {
            put(session, &format!("quad/run/{key}")).await;
        }
    }
    evaluator.put("quad/run/progress/e", vec![0; 5000]).await.unwrap();
    // A router may limit how many are passed on in a second.
    sleep(LULL).await;
    put(&evaluator, "quad/run/progress/last").await;
    let mut keys = until(&heard, "quad/run/progress/last").await;
    while !keys.iter().any(|key| key == "quad/run/weights") {
        keys.extend(until(&heard, "quad/run/weights").await);
    }
    keys.sort();
    let expected = ["progress/e", "progress/last", "weights"];
    assert_eq!(keys, expected.map(|key| format!("quad/run/{key}")));
    assert_eq!(until(&weights, "quad/run/weights").await.len(), 1);
    assert!(weights.try_recv().unwrap().is_none() && spied.try_recv().unwrap().is_none());
}

#[tokio::test(flavor = "multi_thread")]
async fn only_learners_answer_and_only_evaluators_ask_for_jobs() {
    let roles = ["learner", "evaluator", "monitor", "evaluator"];
    let Some((_router, sessions)) = at_the_router(roles).await else { return };
    let [learner, evaluator, monitor, other] = sessions;
    for impostor in [&evaluator, &monitor] {
        let _all = answer(impostor, "quad/run/**").await;
        let _jobs = answer(impostor, "quad/run/jobs").await;
        sleep(LULL).await;
        assert_eq!(answers(&other, "quad/run/jobs").await, 0, "{impostor:?}");
    }
    let mut held = Vec::new();
    for key in ["jobs", "scores", "experience", "weights/*"] {
        held.push(answer(&learner, &format!("quad/run/{key}")).await);
    }
    for (session, key, expected) in [
        (&evaluator, "quad/run/jobs", 1),
        (&evaluator, "quad/run/scores", 1),
        (&evaluator, "quad/run/experience", 1),
        (&evaluator, "quad/run/weights/7", 1),
        (&monitor, "quad/run/jobs", 0),
        (&monitor, "quad/run/scores", 0),
        (&monitor, "quad/run/experience", 0),
        (&monitor, "quad/run/weights/7", 1),
    ] {
        let deadline = Instant::now() + PATIENCE;
        while answers(session, key).await != expected {
            assert!(Instant::now() < deadline, "{key} has not {expected} answers for {session:?}");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn only_learners_and_evaluators_declare_tokens() {
    let roles = ["learner", "evaluator", "monitor", "monitor"];
    let Some((_router, sessions)) = at_the_router(roles).await else { return };
    let [learner, evaluator, monitor, listener] = sessions;
    let mut held = Vec::new();
    for (session, key) in [
        (&evaluator, "quad/forged/live/learner/1"),
        (&monitor, "quad/forged/live/learner/1"),
        (&learner, "quad/run/live/learner/1"),
        (&evaluator, "quad/run/live/evaluator/e"),
        (&monitor, "quad/run/live/evaluator/m"),
    ] {
        held.push(session.liveliness().declare_token(key).await.unwrap());
    }
    let tokens = listener.liveliness().declare_subscriber("quad/**").history(true).await.unwrap();
    let mut there = vec![next(&tokens).await, next(&tokens).await];
    sleep(LULL).await;
    there.extend(tokens.try_recv().unwrap().map(|token| token.key_expr().to_string()));
    there.sort();
    assert_eq!(there, ["quad/run/live/evaluator/e", "quad/run/live/learner/1"]);
}

/// Asserts that not even another learner may speak in its place.
#[tokio::test(flavor = "multi_thread")]
async fn at_a_learner_that_listens_only_evaluators_progress_passes() {
    let Some(certificates) = Certificates::make() else { return };
    let (scratch, folder) = (Scratch::new(), certificates.argument("learner"));
    let listen = ["--listen", "tls/127.0.0.1:0", "--certificates", &folder];
    let learner = scratch.learner_with("run", ENDLESS, &listen);
    let (endpoint, authority) = (learner.endpoint(), certificates.of("learner"));
    let connect = async |role| come_in(&endpoint, &authority, &certificates.of(role)).await;
    let (witness, asker) = (connect("monitor").await, connect("evaluator").await);
    let (evaluator, second) = (connect("evaluator").await, connect("learner").await);
    let heard = witness.declare_subscriber("quad/forged/**").await.unwrap();
    for session in [&second, &evaluator] {
        session.put("quad/forged/weights", "mine").await.unwrap();
        let _held = answer(session, "quad/forged/jobs").await;
        sleep(LULL).await;
        assert_eq!(answers(&asker, "quad/forged/jobs").await, 0);
    }
    eventually("the witness hears of progress, and of nothing else", PATIENCE, || {
        zenoh::Wait::wait(evaluator.put("quad/forged/progress/e", "half")).unwrap();
        let sample = heard.recv_timeout(LULL).unwrap()?;
        assert_eq!(sample.key_expr().as_str(), "quad/forged/progress/e");
        Some(())
    });
}
