//! A server of one file that follows a script.

use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};

#[derive(Clone, Debug)]
pub enum Answer {
    /// Sends this many bytes of the requested part, and closes the connection.
    Send(usize),
    /// Sends this many bytes, and then nothing.
    Stall(usize),
    /// Sends a status line and headers, and then these bytes.
    Other(String, Vec<u8>),
}

pub const WHOLE: Answer = Answer::Send(usize::MAX);

pub struct Server {
    pub url: String,
    requests: Arc<Mutex<Vec<usize>>>,
}

impl Server {
    /// Serves `content` on a free port: one answer per request, the last of them forever.
    pub fn start(content: &[u8], answers: &[Answer]) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}/file.hdf5", listener.local_addr().unwrap());
        let requests = Arc::new(Mutex::new(Vec::new()));
        let (content, log) = (content.to_owned(), requests.clone());
        let mut answers = VecDeque::from(answers.to_owned());
        std::thread::spawn(move || {
            while let Ok((stream, _)) = listener.accept() {
                let start = read_request(&stream);
                log.lock().unwrap().push(start.unwrap_or(0));
                let answer = answers.front().unwrap().clone();
                if answers.len() > 1 {
                    answers.pop_front();
                }
                let content = content.clone();
                // The client may leave at any time.
                std::thread::spawn(move || reply(stream, start, &content, answer).ok());
            }
        });
        Self { url, requests }
    }

    /// First byte of each request.
    pub fn requests(&self) -> Vec<usize> {
        self.requests.lock().unwrap().clone()
    }
}

fn read_request(stream: &TcpStream) -> Option<usize> {
    let lines = BufReader::new(stream).lines().map_while(Result::ok);
    let lines = lines.take_while(|line| !line.is_empty());
    let start = |line: String| {
        let line = line.to_ascii_lowercase();
        line.strip_prefix("range: bytes=")?.strip_suffix('-')?.parse().ok()
    };
    // Reads all lines: closing a connection with unread bytes would reset it.
    lines.filter_map(start).last()
}

fn reply(
    mut stream: TcpStream,
    start: Option<usize>,
    content: &[u8],
    answer: Answer,
) -> std::io::Result<()> {
    let rest = &content[start.unwrap_or(0)..];
    let (last, length) = (content.len() - 1, rest.len());
    let head = match start {
        None => "200 OK".to_owned(),
        Some(start) => {
            format!("206 Partial Content\r\nContent-Range: bytes {start}-{last}/*")
        }
    };
    let head = format!("{head}\r\nContent-Length: {length}");
    let is_silent = matches!(answer, Answer::Stall(_));
    let (head, body) = match answer {
        Answer::Send(count) | Answer::Stall(count) => (head, rest[..count.min(length)].to_owned()),
        Answer::Other(head, body) => (head, body),
    };
    write!(stream, "HTTP/1.1 {head}\r\nConnection: close\r\n\r\n")?;
    stream.write_all(&body)?;
    if is_silent {
        // Ends when the client leaves.
        let _ = stream.read(&mut [0])?;
    }
    Ok(())
}
