//! The web page of runs: a learner shows its own run, `learner page` all runs below a folder.
//!
//! The web server's tasks query one thread, which reads run folders and caches its answers, so
//! neither a slow disk nor a busy browser slows down training.
//!
//! In reading order: `reader` reads the runs, `history` keeps the metrics of one. The browser's
//! side is `assets/page`.

mod history;
mod reader;

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread;

use axum::Router;
use axum::body::Bytes;
use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use serde_json::Value;
use tokio::sync::oneshot;

use reader::{Query, Reader, Request};

/// Queries that wait for the reader; the server answers more of them with 503.
const MAX_QUERIES: usize = 64;
/// Only the page's own files are loaded, and no inline script runs.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; base-uri 'none'; \
                      form-action 'none'; frame-ancestors 'none'";

macro_rules! asset {
    ($file:literal) => {
        include_str!(concat!("../../assets/page/", $file))
    };
}

const FILES: [(&str, &str, &str); 6] = [
    ("/", "text/html; charset=utf-8", asset!("index.html")),
    ("/page.css", "text/css", asset!("page.css")),
    ("/page.js", "text/javascript", asset!("page.js")),
    ("/charts.js", "text/javascript", asset!("charts.js")),
    ("/dygraph.css", "text/css", asset!("dygraph.min.css")),
    ("/dygraph.js", "text/javascript", asset!("dygraph.min.js")),
];

/// Describes a learner's current state.
pub(crate) type Live = Arc<dyn Fn() -> Value + Send + Sync>;

#[derive(Clone)]
struct Site {
    queries: SyncSender<Request>,
    live: Option<Live>,
}

/// The page at `/` and its API, of the runs in or below a folder; `live` describes the learner of
/// the folder's own run.
pub(crate) fn routes(root: PathBuf, live: Option<Live>) -> io::Result<Router> {
    let (queries, rx) = sync_channel(MAX_QUERIES);
    thread::Builder::new().name("page".to_owned()).spawn(move || Reader::new(root).run(&rx))?;
    let mut router = Router::new();
    for (path, kind, text) in FILES {
        let headers = [
            (header::CONTENT_TYPE, kind),
            (header::CONTENT_SECURITY_POLICY, POLICY),
            (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
            (header::CACHE_CONTROL, "no-cache"),
        ];
        router = router.route(path, get(async move || (headers, text)));
    }
    let router = router
        .route("/api/runs", get(runs))
        .route("/api/run/{*name}", get(run))
        .route("/api/live", get(live_state));
    Ok(router.with_state(Site { queries, live }))
}

async fn runs(State(site): State<Site>) -> Response {
    site.query(Query::Runs).await
}

async fn run(State(site): State<Site>, Path(name): Path<String>) -> Response {
    site.query(Query::Run(name)).await
}

async fn live_state(State(site): State<Site>) -> Response {
    json(site.live.map(|live| live().to_string().into()))
}

impl Site {
    async fn query(self, query: Query) -> Response {
        let (tx, rx) = oneshot::channel();
        if self.queries.try_send((query, tx)).is_err() {
            return StatusCode::SERVICE_UNAVAILABLE.into_response();
        }
        json(rx.await.ok().flatten())
    }
}

fn json(body: Option<Bytes>) -> Response {
    let headers = [(header::CONTENT_TYPE, "application/json"), (header::CACHE_CONTROL, "no-store")];
    match body {
        Some(json) => (headers, json).into_response(),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}

#[cfg(test)]
mod tests;
