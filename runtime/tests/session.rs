//! Limits and errors of sessions over TCP. tests/tests/service tests connections of the programs.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::Duration;

use quad_runtime::{Endpoints, SessionError, open_session, reachable_at};
use tokio::time::timeout;
use zenoh::Session;
use zenoh::qos::CongestionControl;

/// Time limit of events that must happen.
const PATIENCE: Duration = Duration::from_secs(60);

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

#[tokio::test(flavor = "multi_thread")]
async fn a_session_that_listens_drops_fragmented_messages() {
    let (learner, endpoint) = meeting_point().await;
    let progress = learner.declare_subscriber("quad/run/progress/*").await.unwrap();
    let evaluator = open_session(&connecting_to(&endpoint)).await.unwrap();
    const LARGEST_REPORT: usize = 30 << 10;
    for size in [100_000, LARGEST_REPORT] {
        let put = evaluator.put("quad/run/progress/e", vec![1; size]);
        put.congestion_control(CongestionControl::Block).await.unwrap();
    }
    let sample = timeout(PATIENCE, progress.recv_async()).await.expect("no progress").unwrap();
    assert_eq!(sample.payload().len(), LARGEST_REPORT);
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
