//! Who may come in: certificates, and what each role may do, at the router as it is shipped and at a learner that
//! listens itself.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::{Mutex, Once};
use std::time::{Duration, Instant};

use quad_tests::certificates::{Certificates, connect};
use quad_tests::router::{protected_router, protected_router_at};
use quad_tests::system::{Scratch, Setting};
use quad_tests::{PATIENCE, eventually};
use tokio::time::timeout;
use zenoh::Session;
use zenoh::handlers::FifoChannelHandler;
use zenoh::pubsub::Subscriber;
use zenoh::query::{Query, Queryable};
use zenoh::sample::{Sample, SampleKind};

/// For what must not happen.
const LULL: Duration = Duration::from_millis(500);

/// What Zenoh logs in this process, where the routers are.
static LOG: Mutex<Vec<u8>> = Mutex::new(Vec::new());

struct Log;

impl Write for Log {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        LOG.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn wait_for_log(text: &str) {
    let what = format!("{text:?} in the router's log");
    eventually(&what, PATIENCE, || String::from_utf8_lossy(&LOG.lock().unwrap()).contains(text).then_some(()));
}

/// `None` if the test is to be skipped.
fn make_certificates() -> Option<Certificates> {
    static START: Once = Once::new();
    START.call_once(|| {
        let filter = "zenoh=warn,zenoh::net::routing::interceptor=trace";
        tracing_subscriber::fmt().with_env_filter(filter).with_ansi(false).with_writer(|| Log).init();
    });
    Certificates::make()
}

/// The keys that arrive until `last` does.
async fn until(samples: &Subscriber<FifoChannelHandler<Sample>>, last: &str) -> Vec<String> {
    let mut keys = Vec::new();
    while keys.last().map(String::as_str) != Some(last) {
        let sample = timeout(PATIENCE, samples.recv_async()).await;
        keys.push(
            sample.unwrap_or_else(|_| panic!("{last} does not arrive, only {keys:?}")).unwrap().key_expr().to_string(),
        );
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

/// How many answers there are.
async fn answers(session: &Session, key: &str) -> usize {
    let replies = session.get(key).timeout(LULL).await.unwrap();
    let mut count = 0;
    while let Ok(reply) = replies.recv_async().await {
        count += usize::from(reply.result().is_ok());
    }
    count
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_completes_through_the_shipped_router() {
    let Some(certificates) = make_certificates() else { return };
    let (_router, endpoint) = protected_router(&certificates.of("router")).await;
    let (scratch, setting) = (Scratch::new(), Setting::default());
    let connect =
        |role| ["--connect".to_owned(), endpoint.clone(), "--certificates".to_owned(), certificates.argument(role)];
    let arguments = connect("evaluator");
    let _evaluator = scratch.evaluator_with("trusted", &arguments.each_ref().map(String::as_str));
    let arguments = connect("learner");
    let mut learner = scratch.learner_with("run", setting, &arguments.each_ref().map(String::as_str));
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&setting);
}

/// Its certificate is for 127.0.0.1, so whoever looks for it elsewhere has met somebody else.
#[tokio::test(flavor = "multi_thread")]
async fn a_router_whose_certificate_is_for_another_host_is_not_believed() {
    let Some(certificates) = make_certificates() else { return };
    let (_router, endpoint) = protected_router_at("127.0.0.2", &certificates.of("router")).await;
    let scratch = Scratch::new();
    let launcher = ["env", "RUST_LOG=info,zenoh=debug"].map(str::to_owned);
    let folder = certificates.argument("evaluator");
    let evaluator =
        scratch.evaluator_through(&launcher, "careful", &["--connect", &endpoint, "--certificates", &folder]);
    evaluator.process.wait_for_log("certificate not valid for name", PATIENCE);
    assert!(!evaluator.process.log().contains("Successfully connected"), "{}", evaluator.process.log());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_learner_that_listens_itself_asks_who_comes() {
    let Some(certificates) = make_certificates() else { return };
    let (scratch, setting) = (Scratch::new(), Setting { steps: 100_000_000, eval_interval: 500, ..Setting::default() });
    let folder = certificates.argument("learner");
    let mut learner = scratch.learner_with("run", setting, &["--listen", "tls/127.0.0.1:0", "--certificates", &folder]);
    let (endpoint, authority) = (learner.endpoint(), certificates.of("learner"));
    assert!(endpoint.starts_with("tls/127.0.0.1:"), "{endpoint}");

    for (name, reason) in [(None, "peer sent no certificates"), (Some("expired"), "certificate expired")] {
        let folder = name.map(|name| certificates.of(name));
        assert!(connect(&endpoint, &authority, folder.as_deref()).await.is_err(), "{name:?} came in");
        learner.process.wait_for_log(reason, PATIENCE);
    }

    // Not even another learner may speak in this one's place; the reports of progress that come after are delivered.
    let witness = connect(&endpoint, &authority, Some(&certificates.of("monitor"))).await.unwrap();
    let heard = witness.declare_subscriber("quad/forged/**").await.unwrap();
    let rogue = connect(&endpoint, &authority, Some(&certificates.of("evaluator"))).await.unwrap();
    let asker = connect(&endpoint, &authority, Some(&certificates.of("evaluator"))).await.unwrap();
    let second = connect(&endpoint, &authority, Some(&certificates.of("learner"))).await.unwrap();
    for session in [&second, &rogue] {
        session.put("quad/forged/weights", "mine").await.unwrap();
        session.put("quad/forged/scores/1", "mine").await.unwrap();
        let _held = answer(session, "quad/forged/jobs").await;
        tokio::time::sleep(LULL).await;
        assert_eq!(answers(&asker, "quad/forged/jobs").await, 0);
    }
    eventually("the witness hears", PATIENCE, || {
        let put = rogue.put("quad/forged/progress/rogue", "half");
        zenoh::Wait::wait(put).unwrap();
        let sample = heard.recv_timeout(LULL).unwrap()?;
        assert_eq!(sample.key_expr().as_str(), "quad/forged/progress/rogue");
        Some(())
    });

    let folder = certificates.argument("evaluator");
    let _evaluator = scratch.evaluator_with("trusted", &["--connect", &endpoint, "--certificates", &folder]);
    eventually("there are scores", PATIENCE, || (learner.scores().len() > 12).then_some(()));
    assert!(learner.process.is_running());
}

#[tokio::test(flavor = "multi_thread")]
async fn the_router_refuses_and_logs_those_without_a_valid_certificate() {
    let Some(certificates) = make_certificates() else { return };
    let elsewhere = make_certificates().unwrap();
    let (_router, endpoint) = protected_router(&certificates.of("router")).await;
    let (authority, evaluator) = (certificates.of("router"), certificates.of("evaluator"));
    // In all but the certificate they are what is let in.
    connect(&endpoint, &authority, Some(&evaluator)).await.expect("an evaluator is let in");
    let foreign = elsewhere.of("evaluator");
    let expired = certificates.of("expired");
    for (folder, reason) in [
        (None, "peer sent no certificates"),
        (Some(&foreign), "invalid peer certificate: UnknownIssuer"),
        (Some(&expired), "invalid peer certificate: certificate expired"),
    ] {
        let session = connect(&endpoint, &authority, folder.map(PathBuf::as_path)).await;
        assert!(session.is_err(), "{folder:?} came in");
        wait_for_log(reason);
    }

    // The other way round: a router that is not of the evaluator's authority, or only an evaluator, is not talked to.
    assert!(connect(&endpoint, &foreign, Some(&foreign)).await.is_err(), "a foreign router was trusted");
    let (_impostor, endpoint) = protected_router(&evaluator).await;
    assert!(connect(&endpoint, &authority, Some(&evaluator)).await.is_err(), "an evaluator passed for a router");

    // And it says so, instead of waiting in silence.
    let (scratch, folder) = (Scratch::new(), elsewhere.argument("evaluator"));
    let stray = scratch.evaluator_with("stray", &["--connect", &endpoint, "--certificates", &folder]);
    stray.process.wait_for_log("refuses the other's certificate", PATIENCE);
    assert!(!stray.process.log().contains("connected"));
}

#[tokio::test(flavor = "multi_thread")]
async fn each_role_may_do_what_it_is_for_and_nothing_else() {
    let Some(certificates) = make_certificates() else { return };
    let (_router, endpoint) = protected_router(&certificates.of("router")).await;
    let authority = certificates.of("router");
    let mut sessions = Vec::new();
    for role in ["learner", "evaluator", "monitor", "monitor", "evaluator"] {
        sessions.push(connect(&endpoint, &authority, Some(&certificates.of(role))).await.unwrap());
    }
    let [learner, evaluator, monitor, listener, receiver] = &sessions[..] else { panic!("five sessions") };

    // What is put: each puts everything, and ends with what it may put. (A session hears itself whoever it is.)
    let heard = listener.declare_subscriber("quad/run/**").await.unwrap();
    let weights = receiver.declare_subscriber("quad/run/weights").await.unwrap();
    let spied = receiver.declare_subscriber("quad/run/progress/*").await.unwrap();
    tokio::time::sleep(LULL).await;
    let everything = ["weights", "scores/1", "progress/e", "jobs", "scores", "weights/1", "live/learner", "*", "**"];
    for key in everything {
        for session in [monitor, evaluator, learner] {
            session.put(format!("quad/run/{key}"), "words").await.unwrap();
        }
    }
    evaluator.put("quad/run/progress/e", vec![0; 5000]).await.unwrap();
    evaluator.delete("quad/run/progress/e").await.unwrap();
    // More than 25 a second are not passed on.
    tokio::time::sleep(LULL).await;
    evaluator.put("quad/run/progress/last", "words").await.unwrap();
    learner.put("quad/run/scores/2", "words").await.unwrap();
    let mut keys = until(&heard, "quad/run/progress/last").await;
    keys.extend(heard.drain().map(|sample| sample.key_expr().to_string()));
    if !keys.iter().any(|key| key == "quad/run/scores/2") {
        keys.extend(until(&heard, "quad/run/scores/2").await);
    }
    keys.sort();
    let allowed = ["progress/e", "progress/last", "scores/1", "scores/2", "weights"];
    assert_eq!(keys, allowed.map(|key| format!("quad/run/{key}")));
    assert_eq!(until(&weights, "quad/run/weights").await.len(), 1);
    assert!(weights.try_recv().unwrap().is_none() && spied.try_recv().unwrap().is_none());
    wait_for_log("is unauthorized to Put (ingress) on quad/run/weights");

    // Who answers: first those who may not.
    for impostor in [evaluator, monitor] {
        let _held = (answer(impostor, "quad/run/**").await, answer(impostor, "quad/run/jobs").await);
        tokio::time::sleep(LULL).await;
        assert_eq!(answers(receiver, "quad/run/jobs").await, 0, "{impostor:?}");
    }
    let mut held = Vec::new();
    for key in ["jobs", "scores", "weights/*"] {
        held.push(answer(learner, &format!("quad/run/{key}")).await);
    }
    for (key, for_evaluators, for_monitors) in [("jobs", 1, 0), ("scores", 1, 0), ("weights/7", 1, 1)] {
        let (key, deadline) = (format!("quad/run/{key}"), Instant::now() + PATIENCE);
        while answers(evaluator, &key).await != for_evaluators {
            assert!(Instant::now() < deadline, "{key} is not answered");
        }
        assert_eq!(answers(monitor, &key).await, for_monitors, "{key}");
    }

    // Who is there.
    for impostor in [evaluator, monitor] {
        held_for_good(impostor.liveliness().declare_token("quad/forged/live/learner").await.unwrap());
    }
    for (session, key) in [(learner, "quad/run/live/learner/1"), (evaluator, "quad/run/live/evaluator/e")] {
        held_for_good(session.liveliness().declare_token(key).await.unwrap());
    }
    held_for_good(monitor.liveliness().declare_token("quad/run/live/evaluator/m").await.unwrap());
    tokio::time::sleep(LULL).await;
    let tokens = listener.liveliness().get("quad/**").timeout(LULL).await.unwrap();
    let mut there = Vec::new();
    while let Ok(reply) = tokens.recv_async().await {
        there.push(reply.result().unwrap().key_expr().to_string());
    }
    there.sort();
    assert_eq!(there, ["quad/run/live/evaluator/e", "quad/run/live/learner/1"]);
}

/// Until the test's end.
fn held_for_good<T>(value: T) {
    std::mem::forget(value);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_expired_certificate_ends_a_connection_and_a_renewed_one_brings_it_back() {
    let Some(certificates) = make_certificates() else { return };
    let (_router, endpoint) = protected_router(&certificates.of("router")).await;
    let monitor = connect(&endpoint, &certificates.of("router"), Some(&certificates.of("monitor"))).await.unwrap();
    let tokens = monitor.liveliness().declare_subscriber("quad/run/live/evaluator/*").history(true).await.unwrap();
    let next = async || timeout(PATIENCE, tokens.recv_async()).await.expect("nobody comes or goes").unwrap().kind();

    let (scratch, endless) = (Scratch::new(), Setting { steps: 100_000_000, eval_interval: 500, ..Setting::default() });
    let folder = certificates.argument("learner");
    let _learner = scratch.learner_with("run", endless, &["--connect", &endpoint, "--certificates", &folder]);
    certificates.short("brief", 15);
    let folder = certificates.argument("brief");
    let evaluator = scratch.evaluator_with("brief", &["--connect", &endpoint, "--certificates", &folder]);
    assert_eq!(next().await, SampleKind::Put);
    assert_eq!(next().await, SampleKind::Delete, "it stays after its certificate has expired");

    certificates.renew("brief");
    assert_eq!(next().await, SampleKind::Put);
    assert!(evaluator.process.log().contains("make a new one soon"));
}
