//! One attempt to get the rest of a file from one address.

use std::io::{self, Read};
use std::time::Duration;

use ureq::http::{Response, StatusCode};
use ureq::{Agent, Body};

use super::partial::Partial;
use super::progress::Progress;
use super::verify::Mismatch;

/// Read at a time.
const CHUNK: usize = 1 << 16;

/// Why an attempt failed.
#[derive(Debug, thiserror::Error)]
pub enum TransferError {
    /// No connection, no answer, or none that is HTTP.
    #[error("{0}")]
    Network(#[from] ureq::Error),
    /// The server has an answer, but not the file.
    #[error("the server answered {0}")]
    Status(StatusCode),
    /// The server's file has another size.
    #[error("the server's file has {found} bytes, but must have {expected}")]
    Size {
        /// What the server says.
        found: u64,
        /// What it must be.
        expected: u64,
    },
    /// Neither the catalogue nor the server knows the size, so nobody could tell half a file from a whole one.
    #[error("the server does not say how large the file is")]
    UnknownSize,
    /// More bytes than the file has.
    #[error("the server sent more than the file's {0} bytes")]
    TooLong(u64),
    /// The connection broke, or was silent for too long.
    #[error("the connection broke after {after} bytes: {reason}")]
    Broken {
        /// Bytes of the file so far.
        after: u64,
        /// What the system says.
        reason: String,
    },
    /// A part of the file was asked for, and something else came.
    #[error("the server did not continue where the last connection broke")]
    WrongRange,
    /// A whole file that is not the right one.
    #[error("what came is not the file: {0}")]
    Mismatch(Mismatch),
    /// The file cannot be written here.
    #[error("{0}")]
    Local(#[from] io::Error),
}

impl TransferError {
    /// Whether the same address may do better a little later.
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Network(error) => !matches!(
                error,
                ureq::Error::BadUri(_) | ureq::Error::Http(_) | ureq::Error::Tls(_) | ureq::Error::TooManyRedirects
            ),
            Self::Status(status) => {
                let busy = [StatusCode::REQUEST_TIMEOUT, StatusCode::TOO_MANY_REQUESTS];
                status.is_server_error() || busy.contains(status)
            }
            Self::Broken { .. } | Self::WrongRange => true,
            Self::Size { .. } | Self::UnknownSize | Self::TooLong(_) | Self::Mismatch(_) | Self::Local(_) => false,
        }
    }
}

/// How long a server may take.
#[derive(Clone, Copy, Debug)]
pub struct Patience {
    /// To be connected to.
    pub connect: Duration,
    /// To send its answer's first line, or the next bytes of the file.
    pub silence: Duration,
}

/// The HTTP client. It heeds `HTTPS_PROXY` and its kin.
pub fn client(patience: Patience) -> Agent {
    Agent::config_builder()
        .timeout_resolve(Some(patience.connect))
        .timeout_connect(Some(patience.connect))
        .timeout_recv_response(Some(patience.silence))
        .timeout_per_read(Some(patience.silence))
        .http_status_as_error(false)
        .user_agent(concat!("quad-learner/", env!("CARGO_PKG_VERSION")))
        .build()
        .new_agent()
}

/// Appends what is missing of a file of `expected` bytes, as far as its size is known.
///
/// The server is asked for the rest alone. One that sends the whole file instead starts it again.
pub fn transfer(
    client: &Agent,
    address: &str,
    expected: Option<u64>,
    partial: &mut Partial,
    progress: &Progress,
) -> Result<(), TransferError> {
    let mut request = client.get(address);
    if partial.len() > 0 {
        request = request.header("Range", format!("bytes={}-", partial.len()));
    }
    let mut response = request.call()?;
    let total = match response.status() {
        StatusCode::OK => {
            partial.clear()?;
            response.body().content_length()
        }
        StatusCode::PARTIAL_CONTENT => match content_range(&response) {
            Some((start, total)) if start == partial.len() && start > 0 => total,
            _ => {
                partial.clear()?;
                return Err(TransferError::WrongRange);
            }
        },
        // There is nothing behind what is here already, so that is not a part of the server's file.
        StatusCode::RANGE_NOT_SATISFIABLE => {
            partial.clear()?;
            return Err(TransferError::WrongRange);
        }
        status => return Err(TransferError::Status(status)),
    };
    let bytes = match (expected, total) {
        (Some(expected), Some(found)) if found != expected => return Err(TransferError::Size { found, expected }),
        (Some(bytes), _) | (None, Some(bytes)) => bytes,
        (None, None) => return Err(TransferError::UnknownSize),
    };
    progress.start(partial.len(), bytes);
    append(response.body_mut(), bytes, partial, progress)
}

/// Appends what a server sends, until there are `bytes`.
fn append(body: &mut Body, bytes: u64, partial: &mut Partial, progress: &Progress) -> Result<(), TransferError> {
    let mut reader = body.as_reader();
    let mut chunk = vec![0; CHUNK];
    loop {
        let broken = |reason| TransferError::Broken { after: partial.len(), reason };
        let count = reader.read(&mut chunk).map_err(|error| broken(error.to_string()))?;
        match partial.len() + count as u64 {
            length if length > bytes => {
                partial.clear()?;
                return Err(TransferError::TooLong(bytes));
            }
            length if count == 0 && length < bytes => return Err(broken("it was closed".to_owned())),
            _ if count == 0 => return Ok(()),
            _ => partial.append(&chunk[..count])?,
        }
        progress.advance(partial.len());
    }
}

/// First byte and size of the whole, from `Content-Range: bytes FIRST-LAST/SIZE`, where SIZE may be `*`.
fn content_range(response: &Response<Body>) -> Option<(u64, Option<u64>)> {
    let range = response.headers().get("content-range")?.to_str().ok()?;
    let (part, total) = range.strip_prefix("bytes ")?.split_once('/')?;
    let (start, _) = part.split_once('-')?;
    Some((start.parse().ok()?, total.parse().ok()))
}
