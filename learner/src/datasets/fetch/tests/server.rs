//! A server of one file that does what a test says, request by request.

use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};

/// What is done with a request.
#[derive(Clone, Debug)]
pub enum Answer {
    /// The file, or the part that was asked for.
    Whole,
    /// So many bytes of that, and the connection is closed.
    Cut(usize),
    /// So many bytes of that, and then silence.
    Stall(usize),
    /// The whole file, whatever was asked for.
    NoRanges,
    /// The beginning of the file, as if it were the part that was asked for.
    WrongRange,
    /// Other bytes, and what `Content-Length` says of them.
    Bytes(Vec<u8>, usize),
    /// Other bytes in one chunk, without saying how many in advance.
    Chunk(Vec<u8>),
    /// Only a status line.
    Status(u16),
    /// The file is elsewhere.
    Redirect(String),
}

pub struct Server {
    address: String,
    /// Where each request wanted to start.
    requests: Arc<Mutex<Vec<Option<usize>>>>,
}

impl Server {
    /// Serves `content` on a free port: an answer a request, the last of them for ever.
    pub fn start(content: &[u8], answers: &[Answer]) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let requests = Arc::new(Mutex::new(Vec::new()));
        let (content, mut answers, log) = (content.to_owned(), VecDeque::from(answers.to_owned()), requests.clone());
        std::thread::spawn(move || {
            while let Ok((stream, _)) = listener.accept() {
                let start = read_request(&stream);
                log.lock().unwrap().push(start);
                let answer = if answers.len() > 1 { answers.pop_front() } else { answers.front().cloned() };
                // The client may leave at any time.
                reply(stream, start, &content, answer.unwrap()).ok();
            }
        });
        Self { address, requests }
    }

    /// The file's address.
    pub fn url(&self) -> String {
        format!("http://{}/file.hdf5", self.address)
    }

    /// Where each request wanted to start.
    pub fn requests(&self) -> Vec<Option<usize>> {
        self.requests.lock().unwrap().clone()
    }
}

fn read_request(stream: &TcpStream) -> Option<usize> {
    let lines = BufReader::new(stream).lines().map_while(Result::ok).take_while(|line| !line.is_empty());
    lines.fold(None, |start, line| {
        let range = line.to_ascii_lowercase();
        range.strip_prefix("range: bytes=").map_or(start, |range| range.trim_end_matches('-').parse().ok())
    })
}

fn reply(mut stream: TcpStream, start: Option<usize>, content: &[u8], answer: Answer) -> std::io::Result<()> {
    let close = "Connection: close\r\n\r\n";
    let part = &content[start.unwrap_or(0)..];
    let mut head = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n{close}", part.len());
    if let Some(start) = start {
        let (last, size) = (content.len() - 1, content.len());
        head = head.replace("200 OK", &format!("206 Partial Content\r\nContent-Range: bytes {start}-{last}/{size}"));
    }
    match answer {
        Answer::Whole => {
            stream.write_all(head.as_bytes())?;
            stream.write_all(part)
        }
        Answer::Cut(count) => {
            stream.write_all(head.as_bytes())?;
            stream.write_all(&part[..count])
        }
        Answer::Stall(count) => {
            stream.write_all(head.as_bytes())?;
            stream.write_all(&part[..count])?;
            // Ends when the client leaves.
            stream.read(&mut [0]).map(drop)
        }
        Answer::NoRanges => {
            write!(stream, "HTTP/1.1 200 OK\r\nContent-Length: {}\r\n{close}", content.len())?;
            stream.write_all(content)
        }
        Answer::WrongRange => {
            let (last, size) = (content.len() - 1, content.len());
            write!(stream, "HTTP/1.1 206 Partial Content\r\nContent-Range: bytes 0-{last}/{size}\r\n")?;
            write!(stream, "Content-Length: {size}\r\n{close}")?;
            stream.write_all(content)
        }
        Answer::Bytes(bytes, length) => {
            write!(stream, "HTTP/1.1 200 OK\r\nContent-Length: {length}\r\n{close}")?;
            stream.write_all(&bytes)
        }
        Answer::Chunk(bytes) => {
            write!(stream, "HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n{close}{:x}\r\n", bytes.len())?;
            stream.write_all(&bytes)?;
            stream.write_all(b"\r\n0\r\n\r\n")
        }
        Answer::Status(status) => write!(stream, "HTTP/1.1 {status} No\r\nContent-Length: 0\r\n{close}"),
        Answer::Redirect(to) => {
            write!(stream, "HTTP/1.1 302 Found\r\nLocation: {to}\r\nContent-Length: 0\r\n{close}")
        }
    }
}
