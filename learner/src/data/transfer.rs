//! One attempt to get the rest of a file from one address.

use std::io::{self, Read};
use std::time::Duration;

use quad_runtime::ProgressBar;
use ureq::http::{Response, StatusCode};
use ureq::{Agent, Body, Error};

use super::partial::Partial;

const CHUNK: usize = 1 << 16;
const CONNECT: Duration = Duration::from_secs(10);

#[derive(Debug)]
pub enum Failure {
    /// The file cannot be written.
    Local(io::Error),
    /// A later attempt at this address may succeed.
    Passing(String),
    /// Further attempts at this address would fail, too.
    Lasting(String),
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        Self::Local(error)
    }
}

/// The HTTP client, which uses `HTTPS_PROXY` and the like. `silence` is the time limit of a server
/// for the first line of its answer, and for the next bytes of the file.
pub fn client(silence: Duration) -> Agent {
    Agent::config_builder()
        .timeout_resolve(Some(CONNECT))
        .timeout_connect(Some(CONNECT))
        .timeout_recv_response(Some(silence))
        .timeout_per_read(Some(silence))
        .http_status_as_error(false)
        .user_agent(concat!("quad-learner/", env!("CARGO_PKG_VERSION")))
        .build()
        .new_agent()
}

/// Appends the rest of a file of `expected` bytes, if that is known. A server that sends the whole
/// file instead starts it again.
pub fn transfer(
    client: &Agent,
    address: &str,
    expected: Option<u64>,
    partial: &mut Partial,
    progress: &ProgressBar,
) -> Result<(), Failure> {
    let mut request = client.get(address);
    if partial.length > 0 {
        request = request.header("Range", format!("bytes={}-", partial.length));
    }
    let mut response = request.call().map_err(network)?;
    let first = match response.status() {
        StatusCode::OK => 0,
        StatusCode::PARTIAL_CONTENT if first_byte(&response) == Some(partial.length) => {
            partial.length
        }
        StatusCode::PARTIAL_CONTENT | StatusCode::RANGE_NOT_SATISFIABLE => {
            partial.clear()?;
            let reason = "the server did not continue where the last connection broke";
            return Err(Failure::Passing(reason.to_owned()));
        }
        status => return Err(refusal(status)),
    };
    let rest = response.body().content_length();
    let bytes = match (expected, rest.map(|rest| first + rest)) {
        (Some(expected), Some(found)) if found != expected => {
            let reason = format!("the server's file has {found} bytes, but must have {expected}");
            return Err(Failure::Lasting(reason));
        }
        (Some(bytes), _) | (None, Some(bytes)) => bytes,
        (None, None) => {
            let reason = "the server does not say how large the file is";
            return Err(Failure::Lasting(reason.to_owned()));
        }
    };
    // Not before: a page in place of the file is refused by its size, and costs no part.
    if first == 0 {
        partial.clear()?;
    }
    progress.start(partial.length, bytes);
    append(response.body_mut(), bytes, partial, progress)
}

/// Appends the answer until the file has `bytes`.
fn append(
    body: &mut Body,
    bytes: u64,
    partial: &mut Partial,
    progress: &ProgressBar,
) -> Result<(), Failure> {
    let mut reader = body.as_reader().take(bytes.saturating_sub(partial.length));
    let mut chunk = vec![0; CHUNK];
    while partial.length < bytes {
        let why = match reader.read(&mut chunk) {
            Ok(0) => "it was closed".to_owned(),
            Err(error) => error.to_string(),
            Ok(count) => {
                partial.append(&chunk[..count])?;
                progress.advance(partial.length);
                continue;
            }
        };
        let reason = format!("the connection broke after {} bytes: {why}", partial.length);
        return Err(Failure::Passing(reason));
    }
    Ok(())
}

fn network(error: Error) -> Failure {
    use Error::{BadUri, Http, Tls, TooManyRedirects};
    let reason = match &error {
        // Its text has the whole address, also a password.
        BadUri(_) => "this is no address of a file".to_owned(),
        error => error.to_string(),
    };
    match error {
        BadUri(_) | Http(_) | Tls(_) | TooManyRedirects => Failure::Lasting(reason),
        _ => Failure::Passing(reason),
    }
}

fn refusal(status: StatusCode) -> Failure {
    let reason = format!("the server answered {status}");
    match status {
        StatusCode::REQUEST_TIMEOUT | StatusCode::TOO_MANY_REQUESTS => Failure::Passing(reason),
        _ if status.is_server_error() => Failure::Passing(reason),
        _ => Failure::Lasting(reason),
    }
}

/// First byte of a part, by `Content-Range: bytes FIRST-LAST/SIZE`.
fn first_byte(response: &Response<Body>) -> Option<u64> {
    let range = response.headers().get("content-range")?.to_str().ok()?;
    let (first, _) = range.strip_prefix("bytes ")?.split_once('-')?;
    first.parse().ok()
}
