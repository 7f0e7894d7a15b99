//! The web page of runs: a learner shows its own run while it works, `learner page` shows all runs
//! below a folder.
//!
//! Owns the page's files, which are part of the program, and a thread that reads run folders. The
//! web server's tasks ask that thread, which answers from memory what it read a moment ago, so
//! neither a slow disk nor a busy browser slows down training. It imports `report` and `run`.
//!
//! In reading order: `reader` reads the runs, `history` keeps the metrics of one. The browser's
//! side is `assets/page`: it shows the metrics of any algorithm.

mod history;
mod reader;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};

use axum::Router;
use axum::body::Bytes;
use axum::extract::{Path as UrlPath, State};
use axum::http::{HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, get};
use serde_json::Value;
use tokio::sync::oneshot;

use reader::{Asked, Question, Reader};

/// Questions that wait for the thread; a browser that asks beyond them is told to ask again.
const MOST_WAITING: usize = 64;
/// Nothing but the page's own files and answers is loaded, and no script that stands in the page
/// itself is run.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; base-uri 'none'; \
                      form-action 'none'; frame-ancestors 'none'";

/// Says what a learner does at this moment.
pub(crate) type Live = Arc<dyn Fn() -> Value + Send + Sync>;

#[derive(Clone)]
struct Site {
    questions: SyncSender<Asked>,
    live: Option<Live>,
}

/// The page at `/`, and what it asks for, of the run in a folder or of all runs below it; `live` is
/// what the learner of the folder's run does.
///
/// # Errors
/// No thread can be started.
pub(crate) fn routes(root: PathBuf, live: Option<Live>) -> std::io::Result<Router> {
    let (questions, asked) = sync_channel(MOST_WAITING);
    std::thread::Builder::new()
        .name("page".to_owned())
        .spawn(move || Reader::new(root).run(&asked))?;
    Ok(Router::new()
        .route("/", file("text/html; charset=utf-8", include_str!("../../assets/page/index.html")))
        .route("/page.css", file("text/css", include_str!("../../assets/page/page.css")))
        .route("/page.js", file("text/javascript", include_str!("../../assets/page/page.js")))
        .route("/charts.js", file("text/javascript", include_str!("../../assets/page/charts.js")))
        .route("/dygraph.css", file("text/css", include_str!("../../assets/page/dygraph.min.css")))
        .route(
            "/dygraph.js",
            file("text/javascript", include_str!("../../assets/page/dygraph.min.js")),
        )
        .route("/api/runs", get(async |State(site): State<Site>| site.ask(Question::Runs).await))
        .route("/api/run/{*name}", get(of_run))
        .route(
            "/api/live",
            get(async |State(site): State<Site>| {
                json(site.live.map(|live| live().to_string().into()))
            }),
        )
        .with_state(Site { questions, live }))
}

fn file<S: Clone + Send + Sync + 'static>(
    kind: &'static str,
    text: &'static str,
) -> MethodRouter<S> {
    let headers: [(HeaderName, &str); 4] = [
        (header::CONTENT_TYPE, kind),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::CACHE_CONTROL, "no-cache"),
    ];
    get(async move || (headers, text))
}

/// The run of a name that the list has.
async fn of_run(State(site): State<Site>, UrlPath(name): UrlPath<String>) -> Response {
    site.ask(Question::Run(name)).await
}

fn json(answer: Option<Bytes>) -> Response {
    let headers = [(header::CONTENT_TYPE, "application/json"), (header::CACHE_CONTROL, "no-store")];
    answer.map_or_else(
        || StatusCode::NOT_FOUND.into_response(),
        |json| (headers, json).into_response(),
    )
}

impl Site {
    async fn ask(self, question: Question) -> Response {
        let (tell, told) = oneshot::channel();
        if self.questions.try_send((question, tell)).is_err() {
            return StatusCode::SERVICE_UNAVAILABLE.into_response();
        }
        json(told.await.ok().flatten())
    }
}

#[cfg(test)]
mod tests;
