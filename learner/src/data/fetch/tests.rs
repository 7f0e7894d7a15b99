//! Tests against servers that cut, lie, redirect, stall and serve garbage.

use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::thread;

use tempfile::TempDir;

use super::*;
use Answer::{Other, Send, Stall};

#[derive(Clone, Debug)]
enum Answer {
    /// Sends this many bytes of the requested part, and closes the connection.
    Send(usize),
    /// Sends this many bytes, and then nothing.
    Stall(usize),
    /// Sends a status line and headers, and then these bytes.
    Other(String, Vec<u8>),
}

const WHOLE: Answer = Answer::Send(usize::MAX);

struct Server {
    url: String,
    requests: Arc<Mutex<Vec<usize>>>,
}

impl Server {
    /// First byte of each request.
    fn requests(&self) -> Vec<usize> {
        self.requests.lock().unwrap().clone()
    }
}

/// Serves the content on a free port: one answer per request, the last of them forever.
fn serve(answers: &[Answer]) -> Server {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}/file.hdf5", listener.local_addr().unwrap());
    let requests = Arc::new(Mutex::new(Vec::new()));
    let (log, mut answers) = (requests.clone(), VecDeque::from(answers.to_owned()));
    thread::spawn(move || {
        while let Ok((stream, _)) = listener.accept() {
            let start = read_request(&stream);
            log.lock().unwrap().push(start.unwrap_or(0));
            let answer = answers.front().unwrap().clone();
            if answers.len() > 1 {
                answers.pop_front();
            }
            // The client may leave at any time.
            thread::spawn(move || reply(stream, start, answer).ok());
        }
    });
    Server { url, requests }
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

fn reply(mut stream: TcpStream, start: Option<usize>, answer: Answer) -> io::Result<()> {
    let (content, first) = (content(), start.unwrap_or(0));
    let (last, length) = (content.len() - 1, content.len() - first);
    let head = match start {
        None => "200 OK".to_owned(),
        Some(first) => format!("206 Partial Content\r\nContent-Range: bytes {first}-{last}/*"),
    };
    let is_silent = matches!(answer, Stall(_));
    let (head, body) = match answer {
        Send(count) | Stall(count) => {
            let body = content[first..first + count.min(length)].to_owned();
            (format!("{head}\r\nContent-Length: {length}"), body)
        }
        Other(head, body) => (head, body),
    };
    write!(stream, "HTTP/1.1 {head}\r\nConnection: close\r\n\r\n")?;
    stream.write_all(&body)?;
    if is_silent {
        // Ends when the client leaves.
        let _ = stream.read(&mut [0])?;
    }
    Ok(())
}

/// A small file: HDF5 by its first bytes, and then numbers without a pattern.
fn content() -> Vec<u8> {
    let numbers = (0..200_000_u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8);
    Vec::from_iter(b"\x89HDF\r\n\x1a\n".iter().copied().chain(numbers))
}

fn garbage() -> Vec<u8> {
    let mut bytes = content();
    bytes[150_000] ^= 1;
    bytes
}

/// An answer of these bytes alone, even to a request for a part.
fn page(bytes: Vec<u8>) -> Answer {
    Other(format!("200 OK\r\nContent-Length: {}", bytes.len()), bytes)
}

fn status(status: &str) -> Answer {
    Other(format!("{status}\r\nContent-Length: 0"), Vec::new())
}

fn dataset(servers: &[&Server]) -> NamedDataset {
    // From Python: hashlib.sha256(content).
    let sha256 = "c7c73dfee4b7d79f660f604ecb6967b5ba390f12727b02bb1c336c8277056b1b";
    NamedDataset {
        name: "hopper-small-v2".to_owned(),
        benchmark: quad_dataset::benchmarks::find("D4RL").unwrap(),
        environment: "hopper".to_owned(),
        file: "file.hdf5".to_owned(),
        bytes: Some(200_008),
        sha256: Some(sha256.to_owned()),
        license: "none".to_owned(),
        addresses: servers.iter().map(|server| server.url.clone()).collect(),
    }
}

/// A fetcher that tries again after milliseconds.
fn fetcher(silence: u64) -> Fetcher {
    let mut fetcher = Fetcher::new(None);
    fetcher.client = client(Duration::from_secs(silence));
    fetcher.pause = Duration::from_millis(2);
    fetcher
}

fn fetch(dataset: &NamedDataset, folder: &TempDir) -> anyhow::Result<LocalDataset> {
    fetcher(60).fetch(dataset, folder.path())
}

fn files(folder: &TempDir) -> Vec<String> {
    let entries = fs::read_dir(folder.path()).unwrap();
    let name = |entry: io::Result<fs::DirEntry>| entry.unwrap().file_name().into_string();
    entries.map(|entry| name(entry).unwrap()).collect()
}

fn part(folder: &TempDir, bytes: &[u8]) {
    fs::write(folder.path().join("file.hdf5.0123.partial"), bytes).unwrap();
}

#[test]
fn a_broken_connection_is_continued_where_it_broke() {
    let wrong_part =
        "206 Partial Content\r\nContent-Range: bytes 0-200007/200008\r\nContent-Length: 200008";
    let wrong_part = Other(wrong_part.to_owned(), content());
    let target = serve(&[Send(70_000), WHOLE]);
    let redirect = status(&format!("302 Found\r\nLocation: {}", target.url));
    let fifth = Send(50_000);
    // The part that an interrupted run has left, the answers, and the first byte of each request.
    for (left, answers, expected) in [
        (&[][..], vec![fifth.clone(); 5], &[0, 50_000, 100_000, 150_000, 200_000][..]),
        (&[], vec![Send(70_000), fifth, WHOLE], &[0, 70_000, 120_000]),
        (&[], vec![redirect; 2], &[0, 70_000]),
        // Silent servers, and some that cannot continue.
        (&[], vec![Stall(1_000), Stall(0), WHOLE], &[0, 1_000, 1_000]),
        (&[], vec![Send(70_000), page(content())], &[0, 70_000]),
        (&[], vec![Send(70_000), wrong_part, WHOLE], &[0, 70_000, 0]),
        (&[], vec![Send(70_000), status("416 No"), WHOLE], &[0, 70_000, 0]),
        (&content()[..70_000], vec![WHOLE], &[70_000]),
        (&content(), vec![WHOLE], &[]),
        (&[7; 200_009], vec![WHOLE], &[0]),
    ] {
        let (folder, server) = (TempDir::new().unwrap(), serve(&answers));
        if !left.is_empty() {
            part(&folder, left);
        }
        let dataset = dataset(&[&server]);
        let silence = if answers.iter().any(|answer| matches!(answer, Stall(_))) { 5 } else { 60 };
        let local = fetcher(silence).fetch(&dataset, folder.path()).unwrap();
        assert!(fs::read(&local.path).unwrap() == content());
        assert_eq!(dataset.sha256, Some(local.sha256));
        assert_eq!(files(&folder), ["file.hdf5"], "nothing else is left");
        assert_eq!(server.requests(), expected, "{answers:?}");
    }
    assert_eq!(target.requests(), [0, 70_000], "a redirect keeps the range");
}

#[test]
fn a_wrong_file_is_refused_and_deleted() {
    let sign_in = || page(b"<!DOCTYPE html><title>Sign in</title>".to_vec());
    let chunk = |bytes: &[u8]| {
        let size = format!("{:x}\r\n", bytes.len());
        let body = [size.as_bytes(), bytes, b"\r\n0\r\n\r\n"].concat();
        Other("200 OK\r\nTransfer-Encoding: chunked".to_owned(), body)
    };
    let sized = dataset(&[]);
    let (mut unknown, mut other) = (sized.clone(), sized.clone());
    (unknown.bytes, unknown.sha256) = (None, None);
    other.sha256 = Some("01234567".repeat(8));
    let prefixed = [b"more", &content()[..]].concat();
    for (dataset, answer, words, count) in [
        (&sized, page(garbage()), "its SHA-256 is", 1),
        (&other, WHOLE, "must be 0123456701234567", 1),
        (&sized, sign_in(), "37 bytes, but must have 200008", 1),
        // The size is not known in advance.
        (&unknown, sign_in(), "not an HDF5 file", 1),
        (&unknown, chunk(&content()), "does not say how large", 1),
        (&sized, chunk(&prefixed), "not an HDF5 file", 1),
        (&sized, chunk(&[0; 50]), "broke after 50 bytes", 4),
    ] {
        let (folder, server) = (TempDir::new().unwrap(), serve(&[answer]));
        let mut dataset = dataset.clone();
        dataset.addresses = vec![server.url.clone()];
        let error = fetch(&dataset, &folder).unwrap_err().to_string();
        assert!(error.contains(&server.url), "{error}");
        assert!(error.contains(words), "{words} is missing in {error}");
        assert!(!folder.path().join("file.hdf5").exists());
        let requests = server.requests().len();
        assert!(requests >= count, "{requests} requests: {error}");
        assert!(requests == 1 || count > 1, "{requests} requests: {error}");
    }
}

#[test]
fn what_is_not_the_file_leads_from_a_mirror_to_the_next_address() {
    let (start, wrong) = (&content()[..70_000], &[7; 70_000][..]);
    let portal = page(b"<!DOCTYPE html>".to_vec());
    for (part_of, answer, first, second) in [
        (start, status("404 No"), vec![70_000], 70_000),
        (start, status("403 No"), vec![70_000], 70_000),
        (start, status("500 No"), vec![70_000; 4], 70_000),
        (start, status("429 No"), vec![70_000; 4], 70_000),
        (start, portal, vec![70_000], 70_000),
        // A part of another file is noticed at the end.
        (wrong, WHOLE, vec![70_000], 0),
    ] {
        let (folder, bad, good) = (TempDir::new().unwrap(), serve(&[answer]), serve(&[WHOLE]));
        part(&folder, part_of);
        let mut fetcher = fetcher(60);
        fetcher.mirror = Some(bad.url.replace("file.hdf5", ""));
        fetcher.fetch(&dataset(&[&good]), folder.path()).unwrap();
        assert_eq!((bad.requests(), good.requests()), (first, vec![second]));
    }
}

#[test]
fn a_file_in_the_cache_is_verified_and_not_changed() {
    let (folder, server) = (TempDir::new().unwrap(), serve(&[WHOLE]));
    let path = folder.path().join("file.hdf5");
    for (bytes, words) in [(b"\x89HDF".to_vec(), "4 bytes"), (garbage(), "SHA-256")] {
        fs::write(&path, &bytes).unwrap();
        let error = fetch(&dataset(&[&server]), &folder).unwrap_err();
        assert!(error.to_string().contains(words), "{error}");
        assert!(fs::read(&path).unwrap() == bytes);
    }
    fs::write(&path, content()).unwrap();
    fetch(&dataset(&[&server]), &folder).unwrap();
    assert_eq!((server.requests().len(), files(&folder).len()), (0, 1));
}

#[test]
fn several_runs_can_fetch_one_file_at_once() {
    let folder = TempDir::new().unwrap();
    let server = serve(&[Stall(70_000), Send(1_000), WHOLE]);
    let dataset = dataset(&[&server]);
    thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| fetcher(5).fetch(&dataset, folder.path()).unwrap());
        }
    });
    assert!(fs::read(folder.path().join("file.hdf5")).unwrap() == content());
    assert_eq!(files(&folder), ["file.hdf5"]);
}

#[test]
fn offline_the_error_names_the_addresses_without_passwords() {
    // No server listens at port 9, and the last name is reserved for belonging to no host.
    for (address, shown) in [
        ("http://user:secret@127.0.0.1:9/folder", "http://…@127.0.0.1:9/folder"),
        ("http://user:se/cret@127.0.0.1:9", "http://…@127.0.0.1:9"),
        ("user:secret@127.0.0.1:9/folder", "…@127.0.0.1:9/folder"),
        ("ftp://user:secret@127.0.0.1:9", "ftp://…@127.0.0.1:9"),
        ("http://127.0.0.1:9", "http://127.0.0.1:9"),
        ("http://nowhere.invalid", "http://nowhere.invalid"),
    ] {
        assert_eq!(without_password(address), shown);
        let folder = TempDir::new().unwrap();
        let mut fetcher = fetcher(60);
        fetcher.mirror = Some(address.to_owned());
        let error = fetcher.fetch(&dataset(&[]), folder.path()).unwrap_err();
        let text = format!("{error:?}");
        assert!(text.contains(&format!("\n  {shown}/file.hdf5: ")), "{text}");
        assert!(!text.contains("cret"), "{text}");
        assert!(files(&folder).is_empty());
    }
}
