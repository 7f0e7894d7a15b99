//! A client for `/metrics`, `/healthz` and Prometheus's API.

use std::io::{Read, Write};
use std::net::TcpStream;
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

pub fn metrics(address: &str) -> Option<String> {
    get(address, "/metrics").filter(|(status, _)| *status == 200).map(|(_, body)| body)
}

/// Sum of the samples of metric `name` whose labels contain `label` (e.g. `reason="hash"`, or
/// nothing).
pub fn sum(page: &str, name: &str, label: &str) -> f64 {
    let samples = page.lines().filter_map(|line| {
        let rest = line.strip_prefix(name)?;
        let (labels, value) = rest.rsplit_once(' ')?;
        let exact = labels.is_empty() || labels.starts_with('{');
        (exact && labels.contains(label)).then(|| value.parse::<f64>().ok())?
    });
    samples.sum()
}
