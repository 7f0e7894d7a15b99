//! Sessions over real TCP: what learner and evaluators need of each other, whichever comes first, goes, or comes back.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::net::{Ipv4Addr, TcpListener};
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::{Duration, Instant};

use quad_runtime::{Endpoints, SessionError, open_session, parse_endpoint, reachable_at};
use rustix::process::{Resource, Rlimit};
use tokio::task::JoinSet;
use tokio::time::timeout;
use zenoh::Session;
use zenoh::handlers::FifoChannelHandler;
use zenoh::pubsub::Subscriber;
use zenoh::qos::CongestionControl;
use zenoh::sample::{Sample, SampleKind};

/// For whatever must happen; on a machine busy with other things.
const PATIENCE: Duration = Duration::from_secs(60);
/// For what must not happen.
const LULL: Duration = Duration::from_millis(500);
/// As many bytes as the paper's snapshot has, which takes many of Zenoh's fragments.
const SNAPSHOT: usize = 6_000_000;

fn listening_at(endpoint: &str) -> Endpoints {
    Endpoints { listen: vec![endpoint.to_owned()], ..Endpoints::default() }
}

fn connecting_to(endpoint: &str) -> Endpoints {
    Endpoints { connect: vec![endpoint.to_owned()], ..Endpoints::default() }
}

/// A session at a port that the system chose, and its endpoint.
async fn meeting_point() -> (Session, String) {
    let endpoints = listening_at("tcp/127.0.0.1:0");
    let session = open_session(&endpoints).await.unwrap();
    let reachable = reachable_at(&session, &endpoints).await.unwrap();
    assert_eq!(reachable.len(), 1, "{reachable:?}");
    assert!(reachable[0].starts_with("tcp/127.0.0.1:") && !reachable[0].ends_with(":0"), "{reachable:?}");
    (session, reachable[0].clone())
}

/// An endpoint at which no process listens for now; its loopback address is not used by anything else, so that no other
/// process takes the port before the test does.
fn free_endpoint() -> String {
    static LAST: AtomicU8 = AtomicU8::new(1);
    let address = Ipv4Addr::new(127, 0, 0, 1 + LAST.fetch_add(1, Ordering::Relaxed));
    let listener = TcpListener::bind((address, 0)).unwrap();
    format!("tcp/{}", listener.local_addr().unwrap())
}

async fn next(samples: &Subscriber<FifoChannelHandler<Sample>>) -> (SampleKind, String) {
    let sample = timeout(PATIENCE, samples.recv_async()).await.expect("nothing arrived").unwrap();
    (sample.kind(), sample.key_expr().to_string())
}

/// What a learner declares; ends when dropped.
async fn declare_learner(session: &Session, run: &str) -> impl Sized + use<> {
    let queryable = session.declare_queryable(format!("quad/{run}/jobs")).await.unwrap();
    let token = session.liveliness().declare_token(format!("quad/{run}/live/learner")).await.unwrap();
    let mut answers = JoinSet::new();
    // Not in a callback: one that sends megabytes holds a thread that all sessions here need to receive them.
    answers.spawn(async move {
        while let Ok(query) = queryable.recv_async().await {
            let mut bytes = query.payload().unwrap().to_bytes().into_owned();
            match &bytes[..] {
                b"weights" => bytes.resize(SNAPSHOT, 0),
                _ => bytes.reverse(),
            }
            query.reply(query.key_expr().clone(), bytes).await.unwrap();
        }
    });
    (answers, token)
}

async fn ask(session: &Session, run: &str, request: Vec<u8>) -> Option<Vec<u8>> {
    let replies = session.get(format!("quad/{run}/jobs")).payload(request).timeout(PATIENCE).await.unwrap();
    let reply = replies.recv_async().await.ok()?;
    Some(reply.result().unwrap().payload().to_bytes().into_owned())
}

/// Everything that a learner and an evaluator do with each other.
async fn talk(learner: &Session, evaluator: &Session, run: &str) {
    let learner_key = format!("quad/{run}/live/learner");
    let learners = evaluator.liveliness().declare_subscriber(&learner_key).history(true).await.unwrap();
    let evaluators_key = format!("quad/{run}/live/evaluator/*");
    let evaluators = learner.liveliness().declare_subscriber(evaluators_key).history(true).await.unwrap();
    let weights_key = format!("quad/{run}/weights");
    let weights = evaluator.declare_subscriber(&weights_key).await.unwrap();
    let progress = learner.declare_subscriber(format!("quad/{run}/progress/*")).await.unwrap();

    let declared = declare_learner(learner, run).await;
    assert_eq!(next(&learners).await, (SampleKind::Put, learner_key.clone()));
    assert_eq!(ask(evaluator, run, vec![1, 2, 3]).await.unwrap(), [3, 2, 1], "the queryable is there with the token");

    let evaluator_key = format!("quad/{run}/live/evaluator/e");
    let token = evaluator.liveliness().declare_token(&evaluator_key).await.unwrap();
    assert_eq!(next(&evaluators).await, (SampleKind::Put, evaluator_key.clone()));

    // The evaluator said that it is there after it subscribed, so nothing is lost from here on.
    let snapshot: Vec<u8> = (0..SNAPSHOT).map(|i| (i % 251) as u8).collect();
    // May be dropped otherwise, should this machine be busy.
    learner.put(&weights_key, snapshot.clone()).congestion_control(CongestionControl::Block).await.unwrap();
    let sample = timeout(PATIENCE, weights.recv_async()).await.expect("no weights arrived").unwrap();
    assert!(sample.payload().to_bytes() == snapshot, "the weights arrived changed");
    assert_eq!(ask(evaluator, run, b"weights".to_vec()).await.unwrap().len(), SNAPSHOT);

    let progress_key = format!("quad/{run}/progress/e");
    evaluator.put(&progress_key, "half").await.unwrap();
    assert_eq!(next(&progress).await, (SampleKind::Put, progress_key));

    token.undeclare().await.unwrap();
    assert_eq!(next(&evaluators).await, (SampleKind::Delete, evaluator_key));
    drop(declared);
    assert_eq!(next(&learners).await, (SampleKind::Delete, learner_key));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_peer_serves_several_clients() {
    let (learner, endpoint) = meeting_point().await;
    let first = open_session(&connecting_to(&endpoint)).await.unwrap();
    let second = open_session(&connecting_to(&endpoint)).await.unwrap();
    let watcher = open_session(&connecting_to(&endpoint)).await.unwrap();
    let published = watcher.declare_subscriber("quad/*/weights").await.unwrap();
    tokio::join!(talk(&learner, &first, "a"), talk(&learner, &second, "b"));
    talk(&learner, &first, "c").await;
    let mut keys = [next(&published).await.1, next(&published).await.1, next(&published).await.1];
    keys.sort();
    assert_eq!(keys, ["quad/a/weights", "quad/b/weights", "quad/c/weights"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_session_that_listens_takes_in_nothing_in_several_pieces() {
    let (learner, endpoint) = meeting_point().await;
    let progress = learner.declare_subscriber("quad/run/progress/*").await.unwrap();
    let _declared = declare_learner(&learner, "run").await;
    let evaluator = open_session(&connecting_to(&endpoint)).await.unwrap();
    let largest_report = vec![1; 30 << 10];
    assert_eq!(ask(&evaluator, "run", largest_report.clone()).await.unwrap(), largest_report);
    for size in [100_000, 1] {
        evaluator.put("quad/run/progress/e", vec![1; size]).congestion_control(CongestionControl::Block).await.unwrap();
    }
    let sample = timeout(PATIENCE, progress.recv_async()).await.expect("no progress arrived").unwrap();
    assert_eq!(sample.payload().len(), 1, "a message in two pieces was taken in");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_waits_for_a_peer_that_has_not_started() {
    let endpoint = free_endpoint();
    let mut opening = tokio::spawn({
        let endpoints = connecting_to(&endpoint);
        async move { open_session(&endpoints).await }
    });
    assert!(timeout(LULL, &mut opening).await.is_err(), "there is no peer to connect to");
    let endpoints = listening_at(&endpoint);
    let learner = open_session(&endpoints).await.unwrap();
    assert_eq!(reachable_at(&learner, &endpoints).await.unwrap(), [endpoint]);
    let evaluator = timeout(PATIENCE, opening).await.expect("it did not connect").unwrap().unwrap();
    talk(&learner, &evaluator, "run").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn waiting_can_be_given_up() {
    let (endpoints, begin) = (connecting_to(&free_endpoint()), Instant::now());
    assert!(timeout(LULL, open_session(&endpoints)).await.is_err(), "there is no peer to connect to");
    assert!(begin.elapsed() < PATIENCE, "it took {:?}", begin.elapsed());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_connects_again_when_the_peer_comes_back() {
    let endpoint = free_endpoint();
    let learner = open_session(&listening_at(&endpoint)).await.unwrap();
    let declared = declare_learner(&learner, "run").await;
    let evaluator = open_session(&connecting_to(&endpoint)).await.unwrap();
    let learners = evaluator.liveliness().declare_subscriber("quad/*/live/learner").history(true).await.unwrap();
    let weights = evaluator.declare_subscriber("quad/run/weights").await.unwrap();
    let key = "quad/run/live/learner".to_owned();
    assert_eq!(next(&learners).await, (SampleKind::Put, key.clone()));
    drop(declared);
    learner.close().await.unwrap();
    assert_eq!(next(&learners).await, (SampleKind::Delete, key.clone()));
    assert_eq!(ask(&evaluator, "run", vec![1]).await, None, "no peer is there to answer");

    let learner = open_session(&listening_at(&endpoint)).await.unwrap();
    let _declared = declare_learner(&learner, "run").await;
    assert_eq!(next(&learners).await, (SampleKind::Put, key));
    assert_eq!(ask(&evaluator, "run", vec![1, 2]).await.unwrap(), [2, 1]);
    let deadline = Instant::now() + PATIENCE;
    while weights.try_recv().unwrap().is_none() {
        assert!(Instant::now() < deadline, "the subscription did not come back");
        learner.put("quad/run/weights", "new").await.unwrap();
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_work_is_an_error_at_once() {
    let (_session, endpoint) = meeting_point().await;
    let open = async |endpoints: Endpoints| timeout(PATIENCE, open_session(&endpoints)).await.unwrap().err().unwrap();
    assert!(matches!(open(Endpoints::default()).await, SessionError::NoEndpoint));
    let taken = open(listening_at(&endpoint)).await;
    let text = taken.to_string();
    assert!(text.contains(&endpoint) && text.contains("in use") && !text.contains(".rs:"), "{text}");
    for wrong in ["127.0.0.1:7447", "smoke/signals:1", "tcp", ""] {
        let error = open(connecting_to(wrong)).await;
        assert!(matches!(&error, SessionError::NotAnEndpoint { endpoint } if endpoint == wrong), "{error}");
    }
}

#[test]
fn endpoints_on_a_command_line() {
    for endpoint in
        ["tcp/127.0.0.1:7447", "tcp/[::1]:0", "tcp/learner.example:7447", "tcp/0.0.0.0:0#iface=lo", "tls/a:1"]
    {
        assert_eq!(parse_endpoint(endpoint).unwrap(), endpoint);
    }
    for wrong in ["127.0.0.1:7447", "udp/127.0.0.1:7447", "tcp", "tcp/", ""] {
        assert!(parse_endpoint(wrong).unwrap_err().to_string().contains("tcp/127.0.0.1:7447"), "{wrong}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn beyond_the_most_connections_no_client_comes_in_until_one_leaves() {
    const MOST: usize = 768;
    // Both ends of each connection are open files of this process.
    let limit = rustix::process::getrlimit(Resource::Nofile);
    rustix::process::setrlimit(Resource::Nofile, Rlimit { current: limit.maximum, ..limit }).unwrap();
    let (learner, endpoint) = meeting_point().await;
    let _declared = declare_learner(&learner, "run").await;
    let (come, mut there) = tokio::sync::mpsc::unbounded_channel();
    for _ in 0..MOST + 20 {
        let (endpoint, come) = (endpoint.clone(), come.clone());
        tokio::spawn(async move { come.send(open_session(&connecting_to(&endpoint)).await.unwrap()).unwrap() });
    }
    let mut sessions = Vec::new();
    while sessions.len() < MOST {
        sessions.push(timeout(PATIENCE, there.recv()).await.expect("there is room").unwrap());
    }
    assert!(timeout(2 * LULL, there.recv()).await.is_err(), "one too many");
    for session in [&sessions[0], &sessions[MOST - 1]] {
        assert_eq!(ask(session, "run", b"abc".to_vec()).await.unwrap(), b"cba");
    }
    sessions.pop().unwrap().close().await.unwrap();
    let last = timeout(PATIENCE, there.recv()).await.expect("there is room again").unwrap();
    assert_eq!(ask(&last, "run", b"abc".to_vec()).await.unwrap(), b"cba");
}
