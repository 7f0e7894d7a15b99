//! The metrics server over TCP, in HTTP/1.1.
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

fn hosts() -> [String; 1] {
    ["learner.lab.svc.cluster.local".to_owned()]
}

async fn server(health: Health) -> (MetricsServer, IntGauge) {
    let registry = Registry::new();
    let gauge = IntGauge::new("quad_test_apples", "Apples in the test.").unwrap();
    registry.register(Box::new(gauge.clone())).unwrap();
    (serve_metrics(ANY_PORT, &hosts(), registry, health, Router::new()).await.unwrap(), gauge)
}

/// Head and body of a response.
async fn get(address: SocketAddr, path: &'static str) -> (String, String) {
    get_as(address, address.to_string(), path).await
}

/// [`get`] from a client that calls this machine `host`.
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
async fn serves_metrics_and_health() {
    let (server, apples) = server(Health::default()).await;
    assert_ne!(server.address.port(), 0);
    apples.set(3);
    let (head, body) = get(server.address, "/metrics").await;
    assert!(head.contains("content-type: text/plain; version=0.0.4"), "{head}");
    assert!(body.ends_with("# TYPE quad_test_apples gauge\nquad_test_apples 3\n"), "{body}");
    let (head, body) = get(server.address, "/healthz").await;
    assert!(head.starts_with("http/1.1 200") && head.contains("connection: close"), "{head}");
    assert_eq!(body, "ok\n");
    let (head, _) = get(server.address, "/secret").await;
    assert!(head.starts_with("http/1.1 404"));
}

#[tokio::test]
async fn requests_for_another_host_are_refused() {
    let (server, _) = server(Health::default()).await;
    for path in ["/metrics", "/healthz", "/secret"] {
        let (head, body) = get_as(server.address, "evil.example".to_owned(), path).await;
        assert!(head.starts_with("http/1.1 403"), "{head}");
        assert!(body.starts_with("ask for this machine"), "{body}");
    }
    for name in ["localhost", "Learner.lab.svc.cluster.local"] {
        let host = format!("{name}:{}", server.address.port());
        assert_eq!(get_as(server.address, host, "/healthz").await.1, "ok\n");
    }
}

#[tokio::test]
async fn unhealthy_components_have_a_line_each() {
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

/// A server with a page that never answers, and a connection that asks for it.
async fn slow_server() -> (MetricsServer, impl Fn() -> TcpStream) {
    let never = Router::new().route("/never", routing::get(std::future::pending::<()>));
    let server = serve_metrics(ANY_PORT, &[], Registry::new(), Health::default(), never);
    let server = server.await.unwrap();
    let address = server.address;
    (server, move || send(address, "GET /never HTTP/1.1\r\nHost: localhost\r\n\r\n"))
}

/// A connection that sends this and nothing more.
fn send(address: SocketAddr, text: &str) -> TcpStream {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.write_all(text.as_bytes()).unwrap();
    stream
}

/// Waits until the server hangs up.
fn wait_for_end(mut stream: &TcpStream) {
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    if let Err(error) = stream.read_to_string(&mut String::new()) {
        assert_eq!(error.kind(), std::io::ErrorKind::ConnectionReset);
    }
}

fn assert_is_open(mut stream: &TcpStream) {
    stream.set_nonblocking(true).unwrap();
    assert_eq!(stream.read(&mut [0]).unwrap_err().kind(), std::io::ErrorKind::WouldBlock);
}

#[tokio::test(flavor = "multi_thread")]
async fn incomplete_requests_are_cut_off_before_complete_ones() {
    let (server, ask) = slow_server().await;
    let complete = ask();
    let incomplete = ["GET /metrics HTTP/1.1\r\nHost: localhost", "GET /met", ""]
        .map(|text| send(server.address, text));
    let ends = move || incomplete.iter().for_each(wait_for_end);
    tokio::task::spawn_blocking(ends).await.unwrap();
    assert_is_open(&complete);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_hundred_waiting_connections_keep_no_client_out() {
    let (server, ask) = slow_server().await;
    let waiting: Vec<TcpStream> = (0..100).map(|_| ask()).collect();
    let (head, _) = get(server.address, "/metrics").await;
    assert!(head.starts_with("http/1.1 200"), "{head}");
    // The first ones made room for the others.
    assert_is_open(&waiting[99]);
    tokio::task::spawn_blocking(move || wait_for_end(&waiting[0])).await.unwrap();
}

#[tokio::test]
async fn an_address_in_use_is_an_error() {
    let (server, _) = server(Health::default()).await;
    let (address, health) = (server.address, Health::default());
    let error = serve_metrics(address, &[], Registry::new(), health, Router::new());
    let error = error.await.unwrap_err();
    assert_eq!(error.to_string(), format!("cannot listen at {address}"));
}
