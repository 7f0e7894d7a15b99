//! Serves `/metrics`, `/healthz` and the pages of a program.

use std::collections::VecDeque;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;
use std::{fs, io};

use axum::Router;
use axum::extract::{Request, State};
use axum::http::uri::Authority;
use axum::http::{StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
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

/// Time limit of a request, which is a few lines in one packet.
const REQUEST: Duration = Duration::from_secs(3);
/// Time limit of a connection, which serves one request.
const CONNECTION: Duration = Duration::from_secs(15);
/// Most connections at a time. A further connection ends the oldest, so that idle clients do not
/// keep others out.
const MOST_CONNECTIONS: usize = 64;
/// Bytes of a request that the server buffers; hyper takes no fewer.
const MOST_BUFFERED: usize = 8 << 10;
/// Pause after a connection could not be accepted, most likely because too many files are open.
const RETRY: Duration = Duration::from_secs(1);

/// The server cannot listen at its address.
#[derive(Debug, thiserror::Error)]
#[error("cannot listen at {address}")]
pub struct ListenError {
    address: SocketAddr,
    source: io::Error,
}

impl ListenError {
    /// Tells the user how to fix it.
    pub fn hint(&self) -> &'static str {
        "another program may listen there: choose another address, or port 0 for a free one"
    }
}

/// Parses a server's address from the command line: a `value_parser`.
pub fn parse_address(text: &str) -> Result<SocketAddr, &'static str> {
    text.parse().map_err(|_| "write ADDR:PORT, such as 127.0.0.1:9600")
}

/// A server, which ends when this is dropped.
#[derive(Debug)]
pub struct MetricsServer {
    /// The server's address, with the port that the system chose for port 0.
    pub address: SocketAddr,
    task: JoinHandle<()>,
}

impl Drop for MetricsServer {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Serves over HTTP at `address`: `/metrics` with the metrics of `registry` in Prometheus's text
/// format; `/healthz` with `ok`, or with status 503 and a line for each problem; and the program's
/// own `pages`.
///
/// A request must name this machine by an address, as `localhost`, as one of `hosts` or, if other
/// machines can ask, by its own name, alone or with a domain that this machine searches.
///
/// The server cuts off clients that send or read slowly, or hold idle connections; they cost a
/// bounded amount of memory.
pub async fn serve_metrics(
    address: SocketAddr,
    hosts: &[String],
    registry: Registry,
    health: Health,
    pages: Router,
) -> Result<MetricsServer, ListenError> {
    let refused = |source| ListenError { address, source };
    let listener = TcpListener::bind(address).await.map_err(refused)?;
    let address = listener.local_addr().map_err(refused)?;
    let metrics = get(metrics).with_state(registry);
    let mut names = hosts.to_vec();
    if !address.ip().is_loopback() {
        let read = |path| fs::read_to_string(path).unwrap_or_default();
        names
            .extend(own_names(read("/proc/sys/kernel/hostname").trim(), &read("/etc/resolv.conf")));
    }
    let own_names = Arc::<[String]>::from(names);
    let router = Router::new()
        .route("/metrics", metrics)
        .route("/healthz", get(healthz).with_state(health))
        .merge(pages)
        .layer(middleware::from_fn_with_state(own_names, refuse_other_names));
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
    server
        .timer(TokioTimer::new())
        .header_read_timeout(REQUEST)
        .max_buf_size(MOST_BUFFERED)
        .keep_alive(false);
    let exchange = server.serve_connection(TokioIo::new(stream), TowerToHyperService::new(router));
    match timeout(CONNECTION, exchange).await {
        Ok(Ok(())) => {}
        Ok(Err(error)) => debug!("a connection to the metrics page broke off: {error}"),
        Err(_) => debug!("a client of the metrics page took longer than {CONNECTION:?}"),
    }
}

/// Refuses requests that name another host. Without this, a web page whose name leads to this machine
/// (DNS rebinding) could read our answers in the browser of a person who visits it.
async fn refuse_other_names(
    State(own_names): State<Arc<[String]>>,
    request: Request,
    next: Next,
) -> Response {
    let is_ours = |name: &[u8]| str::from_utf8(name).is_ok_and(|name| names_us(name, &own_names));
    if request.headers().get(header::HOST).is_none_or(|name| is_ours(name.as_bytes())) {
        return next.run(request).await;
    }
    let hint = "ask for this machine by its address, or as localhost on the machine itself; --http-hosts adds names\n";
    (StatusCode::FORBIDDEN, hint).into_response()
}

/// Names of this machine for others: its first name, its full name, and its first name in each
/// domain that the resolver searches. In other domains, the first name may be a stranger's.
fn own_names(name: &str, resolver: &str) -> Vec<String> {
    let Some(first) = name.split('.').next().filter(|first| !first.is_empty()) else {
        return Vec::new();
    };
    let lists = resolver
        .lines()
        .map(str::split_whitespace)
        .filter_map(|mut words| matches!(words.next(), Some("search" | "domain")).then_some(words));
    let domains = lists.flatten().map(|domain| format!("{first}.{domain}"));
    domains.chain([first.to_owned(), name.to_owned()]).collect()
}

/// True if `host` is an address, `localhost`, or one of our own names.
fn names_us(host: &str, own_names: &[String]) -> bool {
    let Ok(authority) = host.parse::<Authority>() else { return false };
    let name = authority.host().trim_matches(['[', ']']);
    let is_ours = |own: &String| name.eq_ignore_ascii_case(own);
    name.parse::<IpAddr>().is_ok()
        || name.eq_ignore_ascii_case("localhost")
        || own_names.iter().any(is_ours)
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

#[cfg(test)]
mod tests {
    use super::{names_us, own_names};

    #[test]
    fn names_of_this_machine() {
        let resolver = "nameserver 192.0.2.1\nsearch\tlab.example.org example.org\n";
        let own = own_names("box7.lan", resolver);
        for (host, anywhere, on_box7) in [
            ("127.0.0.1:8080", true, true),
            ("[::1]:8080", true, true),
            ("192.0.2.1", true, true),
            ("localhost", true, true),
            ("LocalHost:9600", true, true),
            ("box7", false, true),
            ("box7:9600", false, true),
            ("box7.lan", false, true),
            ("Box7.example.org:9600", false, true),
            ("box7.lab.example.org", false, true),
            ("evil.example", false, false),
            ("box7.evil.example", false, false),
            ("box7.org", false, false),
            (":9600", false, false),
            ("localhost.evil.example", false, false),
            ("127.0.0.1.evil.example:80", false, false),
            ("user@evil.example", false, false),
            ("", false, false),
            ("a b", false, false),
        ] {
            let nameless = own_names("", "search evil.example");
            assert_eq!(names_us(host, &nameless), anywhere, "{host}");
            assert_eq!(names_us(host, &own), on_box7, "{host}");
        }
    }
}
