//! A server of one file that does what a test says, request by request.

use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};

/// What is done with a request.
#[derive(Clone, Debug)]
pub enum Answer {
    /// So many bytes of the file, or of the part that was asked for, and the connection is closed.
    Send(usize),
    /// So many, and then silence.
    Stall(usize),
    /// A status line and headers, and then these bytes, whatever was asked for.
    Other(String, Vec<u8>),
}

pub const WHOLE: Answer = Answer::Send(usize::MAX);

pub struct Server {
    pub url: String,
    requests: Arc<Mutex<Vec<Option<usize>>>>,
}

impl Server {
    /// Serves `content` on a free port: an answer a request, the last of them for ever.
    pub fn start(content: &[u8], answers: &[Answer]) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}/file.hdf5", listener.local_addr().unwrap());
        let requests = Arc::new(Mutex::new(Vec::new()));
        let (content, mut answers, log) =
            (content.to_owned(), VecDeque::from(answers.to_owned()), requests.clone());
        std::thread::spawn(move || {
            while let Ok((stream, _)) = listener.accept() {
                let start = read_request(&stream);
                log.lock().unwrap().push(start);
                let answer =
                    if answers.len() > 1 { answers.pop_front() } else { answers.front().cloned() };
                let content = content.clone();
                // The client may leave at any time.
                std::thread::spawn(move || reply(stream, start, &content, answer.unwrap()).ok());
            }
        });
        Self { url, requests }
    }

    /// Where each request wanted to start.
    pub fn requests(&self) -> Vec<Option<usize>> {
        self.requests.lock().unwrap().clone()
    }
}

fn read_request(stream: &TcpStream) -> Option<usize> {
    let lines =
        BufReader::new(stream).lines().map_while(Result::ok).take_while(|line| !line.is_empty());
    let start = |line: String| {
        line.to_ascii_lowercase().strip_prefix("range: bytes=")?.trim_end_matches('-').parse().ok()
    };
    lines.filter_map(start).last()
}

fn reply(
    mut stream: TcpStream,
    start: Option<usize>,
    content: &[u8],
    answer: Answer,
) -> std::io::Result<()> {
    let rest = &content[start.unwrap_or(0)..];
    let head = match start {
        None => "200 OK".to_owned(),
        Some(start) => {
            format!("206 Partial Content\r\nContent-Range: bytes {start}-{}/*", content.len() - 1)
        }
    };
    let head = format!("{head}\r\nContent-Length: {}", rest.len());
    let is_silent = matches!(answer, Answer::Stall(_));
    let (head, body) = match answer {
        Answer::Send(count) | Answer::Stall(count) => {
            (head, rest[..count.min(rest.len())].to_owned())
        }
        Answer::Other(head, body) => (head, body),
    };
    write!(stream, "HTTP/1.1 {head}\r\nConnection: close\r\n\r\n")?;
    stream.write_all(&body)?;
    // Ends when the client leaves.
    if is_silent { stream.read(&mut [0]).map(drop) } else { Ok(()) }
}
