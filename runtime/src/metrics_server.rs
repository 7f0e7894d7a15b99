//! Serves `/metrics`, `/healthz` and the pages of a program.

use std::collections::VecDeque;
use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use axum::Router;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::routing::get;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use prometheus::{Registry, TEXT_FORMAT, TextEncoder};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::{AbortHandle, JoinHandle, JoinSet};
use tokio::time::timeout;
use tracing::{debug, warn};

use crate::health::Health;

/// A request is a few lines in one packet. The server closes a connection whose request is incomplete after this time.
const REQUEST: Duration = Duration::from_secs(3);
/// A connection serves one request, and lasts at most this long, however slowly its client reads.
const CONNECTION: Duration = Duration::from_secs(15);
/// Most connections at a time. A further connection ends the oldest, so that idle clients do not keep others out.
const MOST_CONNECTIONS: usize = 64;
/// Bytes of a connection's request that the server buffers; hyper takes no fewer.
const MOST_BUFFERED: usize = 8 << 10;
/// Pause after a connection could not be accepted, most likely because too many files are open.
const RETRY: Duration = Duration::from_secs(1);

/// Serves as long as this value lives.
#[derive(Debug)]
pub struct MetricsServer {
    /// Where the server listens; if port 0 was asked for, with the port that the system chose.
    pub address: SocketAddr,
    task: JoinHandle<()>,
}

/// The server cannot listen at the address.
#[derive(Debug, thiserror::Error)]
#[error("cannot serve metrics at {address}")]
pub struct BindError {
    /// The address.
    pub address: SocketAddr,
    /// The cause.
    pub source: io::Error,
}

impl BindError {
    /// What to do about it.
    pub fn hint(&self) -> &'static str {
        "choose another address or port for --http, or port 0 for a free one"
    }
}

/// Serves over HTTP at `address`: `/metrics` with the metrics of `registry` in Prometheus's text format; `/healthz` with `ok`,
/// or with status 503 and a line for each problem; and the program's own `pages`.
///
/// The server cuts off clients that send or read slowly, or hold idle connections; they cost a bounded amount of memory.
///
/// # Errors
/// The server cannot listen at the address.
pub async fn serve_metrics(
    address: SocketAddr,
    registry: Registry,
    health: Health,
    pages: Router,
) -> Result<MetricsServer, BindError> {
    let bind_error = |source| BindError { address, source };
    let listener = TcpListener::bind(address).await.map_err(bind_error)?;
    let address = listener.local_addr().map_err(bind_error)?;
    let metrics = get(metrics).with_state(registry);
    let router =
        Router::new().route("/metrics", metrics).route("/healthz", get(healthz).with_state(health)).merge(pages);
    let task = tokio::spawn(accept(listener, router));
    Ok(MetricsServer { address, task })
}

async fn accept(listener: TcpListener, router: Router) {
    // Dropped with this task, the set ends all connections.
    let mut connections = JoinSet::new();
    let mut oldest_first: VecDeque<AbortHandle> = VecDeque::new();
    loop {
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                warn!("a connection to the metrics page cannot be accepted: {error}");
                tokio::time::sleep(RETRY).await;
                continue;
            }
        };
        while connections.try_join_next().is_some() {}
        oldest_first.retain(|connection| !connection.is_finished());
        if oldest_first.len() >= MOST_CONNECTIONS
            && let Some(oldest) = oldest_first.pop_front()
        {
            oldest.abort();
        }
        oldest_first.push_back(connections.spawn(answer(stream, router.clone())));
    }
}

/// One request and its response.
async fn answer(stream: TcpStream, router: Router) {
    let mut server = http1::Builder::new();
    server.timer(TokioTimer::new()).header_read_timeout(REQUEST).max_buf_size(MOST_BUFFERED).keep_alive(false);
    let exchange = server.serve_connection(TokioIo::new(stream), TowerToHyperService::new(router));
    match timeout(CONNECTION, exchange).await {
        Ok(Ok(())) => {}
        Ok(Err(error)) => debug!("a connection to the metrics page broke off: {error}"),
        Err(_) => debug!("a client of the metrics page took longer than {CONNECTION:?}"),
    }
}

async fn metrics(State(registry): State<Registry>) -> impl IntoResponse {
    match TextEncoder::new().encode_to_string(&registry.gather()) {
        Ok(text) => Ok(([(header::CONTENT_TYPE, TEXT_FORMAT)], text)),
        Err(error) => Err((StatusCode::INTERNAL_SERVER_ERROR, error.to_string())),
    }
}

async fn healthz(State(health): State<Health>) -> (StatusCode, String) {
    match health.problems() {
        problems if problems.is_empty() => (StatusCode::OK, "ok\n".to_owned()),
        problems => (StatusCode::SERVICE_UNAVAILABLE, problems.join("\n") + "\n"),
    }
}

impl Drop for MetricsServer {
    fn drop(&mut self) {
        self.task.abort();
    }
}
