//! Rights of each role: at the router as it is shipped, and at a learner that listens itself.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use quad_tests::certificates::{Certificates, connect};
use quad_tests::made_up::put;
use quad_tests::router::protected_router;
use quad_tests::setting::IDLE;
use quad_tests::system::Scratch;
use quad_tests::wait_until;
use zenoh::query::{Query, Queryable};
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use crate::access::HOST;

/// Time for an answer that must not come; one that must is asked for again.
const LULL: Duration = Duration::from_millis(500);

/// Messages that a subscriber has heard: a key, then words.
type Heard = Arc<Mutex<BTreeSet<String>>>;

/// A listener's memory, and what is to be called with each sample.
fn memory() -> (Heard, impl Fn(Sample) + Send + Sync + 'static) {
    let heard = Heard::default();
    let list = heard.clone();
    let hear = move |sample: Sample| {
        let words = String::from_utf8_lossy(&sample.payload().to_bytes()).into_owned();
        list.lock().unwrap().insert(format!("{} {words}", sample.key_expr()));
    };
    (heard, hear)
}

async fn listen(session: &Session, key: &str) -> Heard {
    let (heard, hear) = memory();
    session.declare_subscriber(key).callback(hear).background().await.unwrap();
    heard
}

/// The keys of those words.
fn keys(heard: &Heard, words: &str) -> Vec<String> {
    let heard = heard.lock().unwrap();
    heard.iter().filter_map(|line| line.strip_suffix(words)).map(str::to_owned).collect()
}

/// Puts words on every kind of key.
async fn say_everything(session: &Session, words: &str) {
    let keys = "weights weights/1 progress/e jobs scores live/learner * **";
    for key in keys.split(' ').map(|key| format!("quad/run/{key}")) {
        put(session, &key, words.as_bytes()).await;
    }
    put(session, "quad/run/progress/large", &[b'w'; 5000]).await;
}

/// Puts until it arrives: before, the router does not know of those who listen.
fn reach(session: &Session, key: &str, heard: &Heard) {
    wait_until(key, || {
        session.put(key, "probe").wait().unwrap();
        keys(heard, " probe").contains(&key.to_owned())
    });
}

/// Answers every question.
async fn answer(session: &Session, key: &str) -> Queryable<()> {
    let reply = |query: Query| _ = query.reply(query.key_expr().clone(), "an answer").wait();
    session.declare_queryable(key).callback(reply).await.unwrap()
}

/// Number of answers.
fn answers(session: &Session, key: &str) -> usize {
    let replies = session.get(key).timeout(LULL).wait().unwrap();
    replies.into_iter().filter(|reply| reply.result().is_ok()).count()
}

#[tokio::test(flavor = "multi_thread")]
async fn each_role_may_say_and_hear_what_it_is_for() {
    let Some(certificates) = Certificates::make() else { return };
    let authority = certificates.path("router");
    let (_router, endpoint) = protected_router(HOST, &authority).await;
    let connect = async |role| connect(&endpoint, &authority, &certificates.path(role)).await;
    let (learner, evaluator) = (connect("learner").await, connect("evaluator").await);
    let (monitor, witness) = (connect("monitor").await, connect("monitor").await);
    let other = connect("evaluator").await;
    let (progress, weights) = ("quad/run/progress/e", "quad/run/weights");

    let heard = listen(&witness, "quad/run/**").await;
    let received = listen(&other, weights).await;
    let spied = listen(&other, "quad/run/progress/*").await;
    reach(&evaluator, progress, &heard);
    reach(&learner, weights, &heard);
    reach(&learner, weights, &received);
    say_everything(&monitor, "monitor").await;
    say_everything(&evaluator, "evaluator").await;
    say_everything(&learner, "learner").await;
    // A session's messages arrive in order: after the answer, all of the monitor's have.
    let _weights = answer(&learner, "quad/run/weights/*").await;
    wait_until("monitors get weights", || answers(&monitor, "quad/run/weights/1") == 1);
    put(&evaluator, progress, b"end").await;
    put(&learner, weights, b"end").await;
    wait_until("the last arrives", || keys(&heard, " end") == [progress, weights]);
    assert_eq!(keys(&heard, " evaluator"), [progress]);
    assert_eq!(keys(&heard, " learner"), [weights]);
    // Those, the two ends and the two probes.
    assert_eq!(heard.lock().unwrap().len(), 6, "{heard:?}");
    wait_until("the last arrives", || keys(&received, " end") == [weights]);
    assert!(spied.lock().unwrap().is_empty(), "evaluators do not hear each other");

    for impostor in [&evaluator, &monitor] {
        let _all = answer(impostor, "quad/run/**").await;
        let _jobs = answer(impostor, "quad/run/jobs").await;
        assert_eq!(answers(&other, "quad/run/jobs"), 0, "{impostor:?}");
    }
    for key in ["jobs", "scores", "experience"].map(|key| format!("quad/run/{key}")) {
        let _queryable = answer(&learner, &key).await;
        wait_until(&key, || answers(&evaluator, &key) == 1);
        assert_eq!(answers(&monitor, &key), 0, "{key}");
    }

    let (tokens, hear) = memory();
    let subscriber = witness.liveliness().declare_subscriber("quad/**").history(true);
    subscriber.callback(hear).background().await.unwrap();
    let mut held = Vec::new();
    for (session, key) in [
        (&monitor, "quad/forged/live/learner/1"),
        (&monitor, "quad/run/live/evaluator/m"),
        (&evaluator, "quad/forged/live/learner/1"),
        (&learner, "quad/run/live/learner/1"),
        (&evaluator, "quad/run/live/evaluator/e"),
    ] {
        held.push(session.liveliness().declare_token(key).await.unwrap());
    }
    wait_until("two tokens arrive", || tokens.lock().unwrap().len() >= 2);
    assert_eq!(keys(&tokens, " "), ["quad/run/live/evaluator/e", "quad/run/live/learner/1"]);
}

/// Not even another learner may speak in its place.
#[tokio::test(flavor = "multi_thread")]
async fn at_a_learner_that_listens_only_evaluators_progress_passes() {
    let Some(certificates) = Certificates::make() else { return };
    let (scratch, folder) = (Scratch::new(), certificates.path("learner"));
    let flags = ["--listen", "tls/127.0.0.1:0", "--certificates", &folder];
    let learner = scratch.learner_with("run", IDLE, &flags);
    let (endpoint, authority) = (learner.endpoint(), certificates.path("learner"));
    let connect = async |role| connect(&endpoint, &authority, &certificates.path(role)).await;
    let (witness, asker) = (connect("monitor").await, connect("evaluator").await);
    let (evaluator, second) = (connect("evaluator").await, connect("learner").await);
    let heard = listen(&witness, "quad/forged/**").await;
    for session in [&second, &evaluator] {
        put(session, "quad/forged/weights", b"mine").await;
        let _queryable = answer(session, "quad/forged/jobs").await;
        assert_eq!(answers(&asker, "quad/forged/jobs"), 0);
    }
    reach(&evaluator, "quad/forged/progress/e", &heard);
    assert_eq!(heard.lock().unwrap().len(), 1);
}
