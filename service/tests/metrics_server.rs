//! The metrics server, asked like Prometheus asks it: over TCP, in HTTP/1.1.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use prometheus::{IntGauge, Registry};
use quad_service::{MetricsServer, serve_metrics};

const ANY_PORT: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 0);

async fn server() -> (MetricsServer, IntGauge) {
    let registry = Registry::new();
    let gauge = IntGauge::new("quad_test_apples", "Apples in the test.").unwrap();
    registry.register(Box::new(gauge.clone())).unwrap();
    (serve_metrics(ANY_PORT, registry).await.unwrap(), gauge)
}

/// Head and body of the response.
async fn get(address: SocketAddr, path: &'static str) -> (String, String) {
    let exchange = move || {
        let mut stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
        let mut response = String::new();
        stream.read_to_string(&mut response).unwrap();
        let (head, body) = response.split_once("\r\n\r\n").unwrap();
        (head.to_ascii_lowercase(), body.to_owned())
    };
    tokio::task::spawn_blocking(exchange).await.unwrap()
}

#[tokio::test]
async fn metrics_in_text_format_as_they_are_now() {
    let (server, apples) = server().await;
    assert_ne!(server.address.port(), 0);
    for count in [3, 5] {
        apples.set(count);
        let (head, body) = get(server.address, "/metrics").await;
        assert!(head.starts_with("http/1.1 200"), "{head}");
        assert!(head.contains("content-type: text/plain; version=0.0.4"), "{head}");
        let expected = "# HELP quad_test_apples Apples in the test.\n# TYPE quad_test_apples gauge\nquad_test_apples ";
        assert_eq!(body, format!("{expected}{count}\n"));
    }
}

#[tokio::test]
async fn health_and_nothing_else() {
    let (server, _) = server().await;
    let (head, body) = get(server.address, "/healthz").await;
    assert!(head.starts_with("http/1.1 200"), "{head}");
    assert_eq!(body, "ok\n");
    assert!(get(server.address, "/secret").await.0.starts_with("http/1.1 404"));
}

#[tokio::test]
async fn an_address_in_use_is_an_error_and_free_again_afterwards() {
    let (server, _) = server().await;
    let address = server.address;
    let error = serve_metrics(address, Registry::new()).await.unwrap_err();
    assert_eq!(error.to_string(), format!("cannot serve metrics at {address}"));
    assert_eq!(error.source.kind(), std::io::ErrorKind::AddrInUse);
    drop(server);
    for _ in 0..100 {
        if serve_metrics(address, Registry::new()).await.is_ok() {
            return;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("{address} is still in use");
}
