//! The web page of runs: a learner shows its own run, `learner page` all runs below a folder.
//!
//! One thread at a time reads run folders, and caches its answers, so neither a slow disk nor a busy
//! browser slows down training.
//!
//! In reading order: `reader` reads the runs, `history` keeps the metrics of one. The browser's
//! side is `assets/page`.

mod history;
mod reader;

use std::path::PathBuf;
use std::sync::Arc;

use axum::Router;
use axum::body::Bytes;
use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use serde_json::Value;
use tokio::sync::Mutex;
use tokio::task::spawn_blocking;

use reader::Reader;

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

pub(crate) type Live = Arc<dyn Fn() -> Value + Send + Sync>;

#[derive(Clone)]
struct Site {
    reader: Arc<Mutex<Reader>>,
    live: Option<Live>,
}

/// The page at `/` and its API, of the runs in or below a folder; `live` describes the learner of
/// the folder's own run.
pub(crate) fn routes(root: PathBuf, live: Option<Live>) -> Router {
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
    let reader = Arc::new(Mutex::new(Reader::new(root)));
    router.with_state(Site { reader, live })
}

async fn runs(State(site): State<Site>) -> Response {
    site.read(|reader| Some(reader.list())).await
}

async fn run(State(site): State<Site>, Path(name): Path<String>) -> Response {
    site.read(|reader| reader.run_page(name)).await
}

async fn live_state(State(site): State<Site>) -> Response {
    json(site.live.map(|live| live().to_string().into()))
}

impl Site {
    async fn read(
        self,
        read: impl FnOnce(&mut Reader) -> Option<Bytes> + Send + 'static,
    ) -> Response {
        let mut reader = self.reader.lock_owned().await;
        let answer = spawn_blocking(move || read(&mut reader));
        json(answer.await.ok().flatten())
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
