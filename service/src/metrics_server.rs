//! `/metrics` and `/healthz`.

use std::io;
use std::net::SocketAddr;

use axum::Router;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::routing::get;
use prometheus::{Registry, TEXT_FORMAT, TextEncoder};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tracing::error;

/// Serves for as long as it is held.
#[derive(Debug)]
pub struct MetricsServer {
    /// Where it listens; with the port that the system chose where 0 was asked for.
    pub address: SocketAddr,
    task: JoinHandle<()>,
}

/// The address cannot be listened at.
#[derive(Debug, thiserror::Error)]
#[error("cannot serve metrics at {address}")]
pub struct BindError {
    /// The address.
    pub address: SocketAddr,
    /// Why not.
    pub source: io::Error,
}

/// Serves over HTTP at `address`: what `registry` gathers at `/metrics`, in Prometheus's text format, and `ok` at
/// `/healthz`.
pub async fn serve_metrics(address: SocketAddr, registry: Registry) -> Result<MetricsServer, BindError> {
    let bind_error = |source| BindError { address, source };
    let listener = TcpListener::bind(address).await.map_err(bind_error)?;
    let address = listener.local_addr().map_err(bind_error)?;
    let router =
        Router::new().route("/metrics", get(metrics)).route("/healthz", get(async || "ok\n")).with_state(registry);
    let task = tokio::spawn(async move {
        if let Err(error) = axum::serve(listener, router).await {
            error!("the metrics server at {address} broke off: {error}");
        }
    });
    Ok(MetricsServer { address, task })
}

async fn metrics(State(registry): State<Registry>) -> impl IntoResponse {
    match TextEncoder::new().encode_to_string(&registry.gather()) {
        Ok(text) => Ok(([(header::CONTENT_TYPE, TEXT_FORMAT)], text)),
        Err(error) => Err((StatusCode::INTERNAL_SERVER_ERROR, error.to_string())),
    }
}

impl Drop for MetricsServer {
    fn drop(&mut self) {
        self.task.abort();
    }
}
