//! The metrics server over TCP, in HTTP/1.1.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use axum::Router;
use axum::routing;
use prometheus::Registry;
use quad_runtime::{Health, MetricsServer, serve_metrics};

const PATIENCE: Duration = Duration::from_secs(60);
const ANY_PORT: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 0);

/// Head and body of a response to a client that calls this machine `host`.
async fn get(address: SocketAddr, host: String, path: &'static str) -> (String, String) {
    let exchange = move || {
        let mut stream = send(address, &format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n"));
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut response = String::new();
        stream.read_to_string(&mut response).unwrap();
        let (head, body) = response.split_once("\r\n\r\n").unwrap();
        (head.to_ascii_lowercase(), body.to_owned())
    };
    tokio::task::spawn_blocking(exchange).await.unwrap()
}

#[tokio::test]
async fn requests_for_another_host_are_refused() {
    let hosts = ["learner.lab.svc.cluster.local".to_owned()];
    let pages = Router::new();
    let server = serve_metrics(ANY_PORT, &hosts, Registry::new(), Health::default(), pages);
    let server = server.await.unwrap();
    for path in ["/metrics", "/healthz", "/secret"] {
        let (head, body) = get(server.address, "evil.example".to_owned(), path).await;
        assert!(head.starts_with("http/1.1 403"), "{head}");
        assert!(body.starts_with("ask for this machine"), "{body}");
    }
    for name in ["localhost", "Learner.lab.svc.cluster.local"] {
        let host = format!("{name}:{}", server.address.port());
        assert_eq!(get(server.address, host, "/healthz").await.1, "ok\n");
    }
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
    let (head, _) = get(server.address, "localhost".to_owned(), "/metrics").await;
    assert!(head.starts_with("http/1.1 200"), "{head}");
    // The first ones made room for the others.
    assert_is_open(&waiting[99]);
    tokio::task::spawn_blocking(move || wait_for_end(&waiting[0])).await.unwrap();
}
