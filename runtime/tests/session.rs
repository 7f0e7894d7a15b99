//! Limits and errors of sessions over TCP. tests/tests/service tests connections of the programs.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::Duration;

use quad_runtime::{Endpoints, SessionError, open_session, reachable_at};
use rustix::process::{Resource, Rlimit};
use tokio::task::JoinSet;
use tokio::time::timeout;
use zenoh::Session;
use zenoh::qos::CongestionControl;

/// Time limit of events that must happen.
const PATIENCE: Duration = Duration::from_secs(60);
/// Time in which an event must not happen.
const LULL: Duration = Duration::from_millis(500);

fn listening_at(endpoint: &str) -> Endpoints {
    let listen = vec![endpoint.to_owned()];
    Endpoints { listen, ..Endpoints::default() }
}

fn connecting_to(endpoint: &str) -> Endpoints {
    let connect = vec![endpoint.to_owned()];
    Endpoints { connect, ..Endpoints::default() }
}

/// A session at a free port, and its endpoint.
async fn meeting_point() -> (Session, String) {
    let endpoints = listening_at("tcp/127.0.0.1:0");
    let session = open_session(&endpoints).await.unwrap();
    let reachable = reachable_at(&session, &endpoints).await.unwrap();
    let [endpoint] = <[String; 1]>::try_from(reachable).unwrap();
    assert!(endpoint.starts_with("tcp/127.0.0.1:") && !endpoint.ends_with(":0"), "{endpoint}");
    (session, endpoint)
}

/// Answers requests for jobs with their reverse, until dropped.
async fn declare_learner(session: &Session) -> impl Sized + use<> {
    let queryable = session.declare_queryable("quad/run/jobs").await.unwrap();
    let mut answers = JoinSet::new();
    answers.spawn(async move {
        while let Ok(query) = queryable.recv_async().await {
            let mut bytes = query.payload().unwrap().to_bytes().into_owned();
            bytes.reverse();
            query.reply(query.key_expr().clone(), bytes).await.unwrap();
        }
    });
    answers
}

async fn ask(session: &Session, request: Vec<u8>) -> Vec<u8> {
    let request = session.get("quad/run/jobs").payload(request);
    let replies = request.timeout(PATIENCE).await.unwrap();
    let reply = replies.recv_async().await.unwrap();
    reply.result().unwrap().payload().to_bytes().into_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_session_that_listens_drops_fragmented_messages() {
    let (learner, endpoint) = meeting_point().await;
    let progress = learner.declare_subscriber("quad/run/progress/*").await.unwrap();
    let _declared = declare_learner(&learner).await;
    let evaluator = open_session(&connecting_to(&endpoint)).await.unwrap();
    let largest_report = vec![1; 30 << 10];
    assert_eq!(ask(&evaluator, largest_report.clone()).await, largest_report);
    for size in [100_000, 1] {
        let put = evaluator.put("quad/run/progress/e", vec![1; size]);
        put.congestion_control(CongestionControl::Block).await.unwrap();
    }
    let sample = timeout(PATIENCE, progress.recv_async()).await.expect("no progress").unwrap();
    assert_eq!(sample.payload().len(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn unusable_endpoints_are_errors_at_once() {
    let (_session, endpoint) = meeting_point().await;
    let open = async |endpoints: Endpoints| {
        let opened = timeout(PATIENCE, open_session(&endpoints)).await;
        opened.unwrap().err().unwrap()
    };
    assert!(matches!(open(Endpoints::default()).await, SessionError::NoEndpoint));
    let text = open(listening_at(&endpoint)).await.to_string();
    assert!(text.contains(&endpoint) && text.contains("in use"), "{text}");
    assert!(!text.contains(".rs:"), "{text}");
    for wrong in "127.0.0.1:7447 udp/127.0.0.1:7447 smoke/signals:1 tcp tcp/ ".split(' ') {
        let error = open(connecting_to(wrong)).await;
        assert!(matches!(&error, SessionError::NotAnEndpoint(text) if text == wrong), "{error}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn connections_beyond_the_limit_wait_until_one_leaves() {
    const MOST: usize = 768;
    // Both ends of each connection are open files of this process.
    let limit = rustix::process::getrlimit(Resource::Nofile);
    let raised = Rlimit { current: limit.maximum, ..limit };
    rustix::process::setrlimit(Resource::Nofile, raised).unwrap();
    let (learner, endpoint) = meeting_point().await;
    let _declared = declare_learner(&learner).await;
    let (tx, mut rx) = tokio::sync::mpsc::unbounded_channel();
    for _ in 0..MOST + 20 {
        let (endpoints, tx) = (connecting_to(&endpoint), tx.clone());
        tokio::spawn(async move { tx.send(open_session(&endpoints).await.unwrap()).unwrap() });
    }
    let mut sessions = Vec::new();
    while sessions.len() < MOST {
        let session = timeout(PATIENCE, rx.recv()).await;
        sessions.push(session.expect("there is room").unwrap());
    }
    assert!(timeout(2 * LULL, rx.recv()).await.is_err(), "one too many");
    for session in [&sessions[0], &sessions[MOST - 1]] {
        assert_eq!(ask(session, b"abc".to_vec()).await, b"cba");
    }
    sessions.pop().unwrap().close().await.unwrap();
    let last = timeout(PATIENCE, rx.recv()).await.expect("there is room again").unwrap();
    assert_eq!(ask(&last, b"abc".to_vec()).await, b"cba");
}
