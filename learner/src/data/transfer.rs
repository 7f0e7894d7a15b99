//! One attempt to get the rest of a file from one address, and files that have arrived in part.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use quad_run::files;
use quad_runtime::ProgressBar;
use ureq::http::{Response, StatusCode};
use ureq::{Agent, Body, Error};

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
        (Some(expected), Some(bytes)) if bytes != expected => {
            let reason = format!("the server's file has {bytes} bytes, but must have {expected}");
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
    match error {
        // Its text has the whole address, also a password.
        Error::BadUri(_) => Failure::Lasting("this is no address of a file".to_owned()),
        Error::Http(_) | Error::Tls(_) | Error::TooManyRedirects => {
            Failure::Lasting(error.to_string())
        }
        error => Failure::Passing(error.to_string()),
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

/// The part of `<file>` that this process has fetched: `<file>.<number>.partial`.
pub struct Partial {
    pub path: PathBuf,
    pub length: u64,
    file: File,
}

impl Partial {
    /// Continues the part that an interrupted process has left of `target`, or makes an empty one.
    pub fn open(target: &Path) -> io::Result<Self> {
        let path = target.with_added_extension(format!("{:08x}.partial", rand::random::<u32>()));
        for (left, _) in partial_files(target) {
            // A process that is still fetching has a lock on its file.
            let Ok(file) = files::append(&left) else { continue };
            if file.try_lock().is_ok() && fs::rename(&left, &path).is_ok() {
                let length = file.metadata()?.len();
                return Ok(Self { path, length, file });
            }
        }
        let file = files::append(&path)?;
        // On a file system without locks, nothing is continued.
        file.try_lock().ok();
        Ok(Self { path, length: 0, file })
    }

    pub fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes)?;
        self.length += bytes.len() as u64;
        Ok(())
    }

    pub fn clear(&mut self) -> io::Result<()> {
        self.length = 0;
        self.file.set_len(0)
    }

    /// Renames the file to `target`, which is whole even after a power cut.
    pub fn finish(self, target: &Path) -> io::Result<()> {
        self.file.sync_all()?;
        fs::rename(&self.path, target)?;
        files::synchronize_folder(target)
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        if self.length == 0 {
            fs::remove_file(&self.path).ok();
        }
    }
}

/// The non-empty partial files of `target`, and their lengths.
pub fn partial_files(target: &Path) -> Vec<(PathBuf, u64)> {
    let folder = target.parent().and_then(|folder| fs::read_dir(folder).ok());
    let file = target.file_name().unwrap_or_default().to_string_lossy();
    let length = |entry: io::Result<fs::DirEntry>| {
        let path = entry.ok()?.path();
        let rest = path.file_name()?.to_str()?.strip_prefix(&*file)?;
        let length = path.metadata().ok()?.len();
        (rest.starts_with('.') && rest.ends_with(".partial") && length > 0)
            .then_some((path, length))
    };
    folder.into_iter().flatten().filter_map(length).collect()
}
