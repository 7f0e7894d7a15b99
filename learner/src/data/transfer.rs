//! One attempt to get the rest of a file from one address.

use std::io::{self, Read};
use std::time::Duration;

use quad_runtime::ProgressBar;
use ureq::http::{Response, StatusCode};
use ureq::{Agent, Body, Error};

use super::partial::Partial;

/// Read at a time.
const CHUNK: usize = 1 << 16;
/// How long a server may take to be connected to.
const CONNECT: Duration = Duration::from_secs(10);

/// Why an attempt failed.
#[derive(Debug)]
pub enum Failure {
    /// The file cannot be written here, which no address can mend.
    Local(io::Error),
    /// A later attempt at this address may succeed.
    Passing(String),
    /// It will not.
    Lasting(String),
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        Self::Local(error)
    }
}

/// The HTTP client, which heeds `HTTPS_PROXY` and its kin. `silence` is how long a server may take
/// for its answer's first line, or for the next bytes of the file.
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

/// Appends what is missing of a file of `expected` bytes, as far as its size is known. The server
/// is asked for the rest alone; one that sends the whole file instead starts it again.
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
    match response.status() {
        StatusCode::OK => partial.clear()?,
        StatusCode::PARTIAL_CONTENT if first_byte(&response) == Some(partial.length) => {}
        StatusCode::PARTIAL_CONTENT | StatusCode::RANGE_NOT_SATISFIABLE => {
            partial.clear()?;
            return Err(Failure::Passing(
                "the server did not continue where the last connection broke".to_owned(),
            ));
        }
        status => return Err(refusal(status)),
    }
    let found = response.body().content_length().map(|rest| partial.length + rest);
    let bytes = match (expected, found) {
        (Some(expected), Some(found)) if found != expected => {
            return Err(Failure::Lasting(format!(
                "the server's file has {found} bytes, but must have {expected}"
            )));
        }
        (Some(bytes), _) | (None, Some(bytes)) => bytes,
        (None, None) => {
            return Err(Failure::Lasting(
                "the server does not say how large the file is".to_owned(),
            ));
        }
    };
    progress.start(partial.length, bytes);
    append(response.body_mut(), bytes, partial, progress)
}

/// Appends what a server sends, until there are `bytes`.
fn append(
    body: &mut Body,
    bytes: u64,
    partial: &mut Partial,
    progress: &ProgressBar,
) -> Result<(), Failure> {
    let mut reader = body.as_reader().take(bytes.saturating_sub(partial.length));
    let mut chunk = vec![0; CHUNK];
    while partial.length < bytes {
        let broken = |why| {
            Failure::Passing(format!("the connection broke after {} bytes: {why}", partial.length))
        };
        match reader.read(&mut chunk) {
            Ok(0) => return Err(broken("it was closed".to_owned())),
            Ok(count) => partial.append(&chunk[..count])?,
            Err(error) => return Err(broken(error.to_string())),
        }
        progress.advance(partial.length);
    }
    Ok(())
}

fn network(error: Error) -> Failure {
    let lasting = matches!(
        error,
        Error::BadUri(_) | Error::Http(_) | Error::Tls(_) | Error::TooManyRedirects
    );
    if lasting { Failure::Lasting(error.to_string()) } else { Failure::Passing(error.to_string()) }
}

fn refusal(status: StatusCode) -> Failure {
    let reason = format!("the server answered {status}");
    let busy = [StatusCode::REQUEST_TIMEOUT, StatusCode::TOO_MANY_REQUESTS].contains(&status);
    if busy || status.is_server_error() {
        Failure::Passing(reason)
    } else {
        Failure::Lasting(reason)
    }
}

/// Where a part begins, by `Content-Range: bytes FIRST-LAST/SIZE`.
fn first_byte(response: &Response<Body>) -> Option<u64> {
    let range = response.headers().get("content-range")?.to_str().ok()?;
    range.strip_prefix("bytes ")?.split_once('-')?.0.parse().ok()
}
