//! A client for `/metrics`, `/healthz` and Prometheus's API; a server of one file.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// Fetches `http://<address><path>`: status and body, or nothing without an answer.
pub fn get(address: &str, path: &str) -> Option<(u16, String)> {
    let mut stream = TcpStream::connect(address).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(60))).ok()?;
    write!(stream, "GET {path} HTTP/1.0\r\nHost: {address}\r\n\r\n").ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    let (head, body) = answer.split_once("\r\n\r\n")?;
    let status = head.split_whitespace().nth(1)?.parse().ok()?;
    Some((status, body.to_owned()))
}

/// The metrics page of a process.
pub fn metrics(address: &str) -> Option<String> {
    get(address, "/metrics").filter(|(status, _)| *status == 200).map(|(_, body)| body)
}

/// Sum of the samples of metric `name` whose labels contain `label` (e.g. `reason="hash"`, or nothing).
pub fn sum(page: &str, name: &str, label: &str) -> f64 {
    let samples = page.lines().filter_map(|line| {
        let rest = line.strip_prefix(name)?;
        let (labels, value) = rest.rsplit_once(' ')?;
        let exact = labels.is_empty() || labels.starts_with('{');
        (exact && labels.contains(label)).then(|| value.parse::<f64>().ok())?
    });
    samples.sum()
}

/// A server of one file, on a port that the system chooses.
pub struct FileServer {
    /// Its address, as `http://host:port`.
    pub url: String,
    requests: Arc<AtomicUsize>,
}

impl FileServer {
    /// Answers a request for `/<name>` with `content`, and every other with 404.
    pub fn start(name: &str, content: Vec<u8>) -> FileServer {
        let listener = TcpListener::bind("127.0.0.1:0").expect("there is a free port");
        let url = format!("http://{}", listener.local_addr().expect("it is bound"));
        let requests = Arc::new(AtomicUsize::new(0));
        let (counter, wanted) = (requests.clone(), format!("GET /{name} HTTP/1.1"));
        std::thread::spawn(move || {
            for mut stream in listener.incoming().map_while(Result::ok) {
                counter.fetch_add(1, Ordering::Relaxed);
                let lines = BufReader::new(&stream).lines().map_while(Result::ok);
                let request: Vec<_> = lines.take_while(|line| !line.is_empty()).collect();
                let (status, body) = match request.first() == Some(&wanted) {
                    true => ("200 OK", content.as_slice()),
                    false => ("404 Not Found", &[][..]),
                };
                let head = format!("HTTP/1.1 {status}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", body.len());
                // The client may leave at any time.
                stream.write_all(head.as_bytes()).and_then(|()| stream.write_all(body)).ok();
            }
        });
        FileServer { url, requests }
    }

    /// How often it was asked.
    pub fn requests(&self) -> usize {
        self.requests.load(Ordering::Relaxed)
    }
}
