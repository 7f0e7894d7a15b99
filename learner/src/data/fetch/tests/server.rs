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
    /// A status line and headers, and then these bytes, whatever was asked for.
    Other(String, Vec<u8>),
}

/// An answer without the file.
pub fn status(status: u16) -> Answer {
    Answer::Other(format!("{status} No\r\nContent-Length: 0"), Vec::new())
}

pub struct Server {
    address: String,
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
                let content = content.clone();
                // The client may leave at any time.
                std::thread::spawn(move || reply(stream, start, &content, answer.unwrap()).ok());
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
    let start =
        |line: String| line.to_ascii_lowercase().strip_prefix("range: bytes=")?.trim_end_matches('-').parse().ok();
    lines.filter_map(start).last()
}

fn reply(mut stream: TcpStream, start: Option<usize>, content: &[u8], answer: Answer) -> std::io::Result<()> {
    let rest = &content[start.unwrap_or(0)..];
    let (count, is_silent) = match answer {
        Answer::Whole => (rest.len(), false),
        Answer::Cut(count) => (count, false),
        Answer::Stall(count) => (count, true),
        Answer::Other(head, body) => {
            write!(stream, "HTTP/1.1 {head}\r\nConnection: close\r\n\r\n")?;
            return stream.write_all(&body);
        }
    };
    let (last, size) = (content.len().saturating_sub(1), content.len());
    let head = match start {
        None => "200 OK".to_owned(),
        Some(start) => format!("206 Partial Content\r\nContent-Range: bytes {start}-{last}/{size}"),
    };
    write!(stream, "HTTP/1.1 {head}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", rest.len())?;
    stream.write_all(&rest[..count])?;
    // Ends when the client leaves.
    if is_silent { stream.read(&mut [0]).map(drop) } else { Ok(()) }
}
