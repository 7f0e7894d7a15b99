//! The metrics server, asked like Prometheus asks it: over TCP, in HTTP/1.1.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use axum::Router;
use axum::routing;
use prometheus::{IntGauge, Registry};
use quad_runtime::{Health, MetricsServer, serve_metrics};

const PATIENCE: Duration = Duration::from_secs(60);
const ANY_PORT: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 0);

async fn server(health: Health) -> (MetricsServer, IntGauge) {
    let registry = Registry::new();
    let gauge = IntGauge::new("quad_test_apples", "Apples in the test.").unwrap();
    registry.register(Box::new(gauge.clone())).unwrap();
    (serve_metrics(ANY_PORT, registry, health, Router::new()).await.unwrap(), gauge)
}

/// Head and body of the response.
async fn get(address: SocketAddr, path: &'static str) -> (String, String) {
    get_as(address, address.to_string(), path).await
}

/// The response to a client that knows this machine by the name `host`.
async fn get_as(address: SocketAddr, host: String, path: &'static str) -> (String, String) {
    let exchange = move || {
        let mut stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n").unwrap();
        let mut response = String::new();
        stream.read_to_string(&mut response).unwrap();
        let (head, body) = response.split_once("\r\n\r\n").unwrap();
        (head.to_ascii_lowercase(), body.to_owned())
    };
    tokio::task::spawn_blocking(exchange).await.unwrap()
}

#[tokio::test]
async fn metrics_and_health_and_nothing_else() {
    let (server, apples) = server(Health::default()).await;
    assert_ne!(server.address.port(), 0);
    apples.set(3);
    let (head, body) = get(server.address, "/metrics").await;
    assert!(head.contains("content-type: text/plain; version=0.0.4"), "{head}");
    assert!(body.ends_with("# TYPE quad_test_apples gauge\nquad_test_apples 3\n"), "{body}");
    let (head, body) = get(server.address, "/healthz").await;
    assert!(head.starts_with("http/1.1 200") && head.contains("connection: close"), "{head}");
    assert_eq!(body, "ok\n");
    assert!(get(server.address, "/secret").await.0.starts_with("http/1.1 404"));
}

#[tokio::test]
async fn a_strangers_name_that_leads_here_is_told_nothing() {
    let (server, _) = server(Health::default()).await;
    for path in ["/metrics", "/healthz", "/secret"] {
        let (head, body) = get_as(server.address, "evil.example".to_owned(), path).await;
        assert!(
            head.starts_with("http/1.1 403") && body.starts_with("ask for this machine"),
            "{head}{body}"
        );
    }
    let host = format!("localhost:{}", server.address.port());
    assert_eq!(get_as(server.address, host, "/healthz").await.1, "ok\n");
}

#[tokio::test]
async fn ill_health_is_told_line_by_line() {
    let health = Health::default();
    let (server, _) = server(health.clone()).await;
    let scores = health.register("scores", Duration::from_secs(3600));
    scores.set_problem(Some("the disk is full".to_owned()));
    drop(health.register("training", Duration::from_secs(3600)));
    let (head, body) = get(server.address, "/healthz").await;
    assert!(head.starts_with("http/1.1 503"), "{head}");
    assert_eq!(body, "scores: the disk is full\ntraining: it ended before its work was done\n");
    let (head, _) = get(server.address, "/metrics").await;
    assert!(head.starts_with("http/1.1 200"), "a sick process is still measured: {head}");
}

/// A server with a page that never comes, and a connection that asks for it, which the server bears
/// for 15 s.
async fn server_that_bears() -> (MetricsServer, impl Fn() -> TcpStream) {
    let never = Router::new().route("/never", routing::get(std::future::pending::<()>));
    let server = serve_metrics(ANY_PORT, Registry::new(), Health::default(), never).await.unwrap();
    let address = server.address;
    (server, move || sends(address, "GET /never HTTP/1.1\r\nHost: localhost\r\n\r\n"))
}

/// A connection on which `sent` is all that the server ever gets.
fn sends(address: SocketAddr, sent: &str) -> TcpStream {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.write_all(sent.as_bytes()).unwrap();
    stream
}

/// Waits until the server hangs up; what it said before.
fn ended(mut stream: &TcpStream) -> String {
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut said = String::new();
    if let Err(error) = stream.read_to_string(&mut said) {
        assert_eq!(error.kind(), std::io::ErrorKind::ConnectionReset);
    }
    said
}

fn assert_is_open(mut stream: &TcpStream) {
    stream.set_nonblocking(true).unwrap();
    assert_eq!(stream.read(&mut [0]).unwrap_err().kind(), std::io::ErrorKind::WouldBlock);
}

#[tokio::test(flavor = "multi_thread")]
async fn half_a_request_and_silence_are_cut_off_long_before_one_that_waits_for_its_answer() {
    let (server, bear) = server_that_bears().await;
    let whole = bear();
    let halves = ["GET /metrics HTTP/1.1\r\nHost: localhost", "GET /met", ""]
        .map(|sent| sends(server.address, sent));
    tokio::task::spawn_blocking(move || halves.iter().for_each(|half| drop(ended(half))))
        .await
        .unwrap();
    assert_is_open(&whole);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_hundred_connections_that_wait_keep_no_client_out() {
    let (server, bear) = server_that_bears().await;
    let waiting: Vec<TcpStream> = (0..100).map(|_| bear()).collect();
    let (head, _) = get(server.address, "/metrics").await;
    assert!(head.starts_with("http/1.1 200"), "{head}");
    // The first ones made room for the others: there is a bound. The client did not wait for the
    // others.
    assert_is_open(&waiting[99]);
    tokio::task::spawn_blocking(move || ended(&waiting[0])).await.unwrap();
}

#[tokio::test]
async fn an_address_in_use_is_an_error() {
    let (server, _) = server(Health::default()).await;
    let address = server.address;
    let error = serve_metrics(address, Registry::new(), Health::default(), Router::new())
        .await
        .unwrap_err();
    assert_eq!(error.to_string(), format!("cannot listen at {address}"));
}
