//! Against servers that cut, lie, redirect, stall and serve garbage.

mod server;

use std::thread;

use tempfile::TempDir;

use super::*;
use server::{
    Answer::{self, Other, Send, Stall},
    Server, WHOLE,
};

/// A small file: HDF5 by its first bytes, and then numbers without a pattern.
fn content() -> Vec<u8> {
    let numbers = (0..200_000_u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8);
    b"\x89HDF\r\n\x1a\n".iter().copied().chain(numbers).collect()
}

/// `content` with one byte changed.
fn garbage() -> Vec<u8> {
    let mut bytes = content();
    bytes[150_000] ^= 1;
    bytes
}

/// An answer of these bytes alone, whatever was asked for.
fn page(bytes: Vec<u8>) -> Answer {
    Other(format!("200 OK\r\nContent-Length: {}", bytes.len()), bytes)
}

/// An answer without the file.
fn status(status: &str) -> Answer {
    Other(format!("{status}\r\nContent-Length: 0"), Vec::new())
}

fn dataset(addresses: &[&Server]) -> NamedDataset {
    NamedDataset {
        name: "hopper-small-v2".to_owned(),
        benchmark: quad_dataset::benchmarks::find("D4RL").unwrap(),
        environment: "hopper".to_owned(),
        file: "file.hdf5".to_owned(),
        bytes: Some(200_008),
        // From Python: hashlib.sha256(content).
        sha256: Some("c7c73dfee4b7d79f660f604ecb6967b5ba390f12727b02bb1c336c8277056b1b".to_owned()),
        license: "none".to_owned(),
        addresses: addresses.iter().map(|server| server.url.clone()).collect(),
    }
}

/// Tries again after milliseconds where the real one waits for seconds.
fn fetcher(silence: u64) -> Fetcher {
    Fetcher {
        client: client(Duration::from_secs(silence)),
        pause: Duration::from_millis(2),
        mirror: None,
    }
}

fn fetch(dataset: &NamedDataset, folder: &TempDir) -> anyhow::Result<LocalDataset> {
    fetcher(60).fetch(dataset, folder.path())
}

fn files(folder: &TempDir) -> Vec<String> {
    let names = fs::read_dir(folder.path())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.collect()
}

/// Fetches from a server with these answers, into a folder where an interrupted run has left a
/// part; the file must be right in the end. Where each request wanted to start.
fn requests(silence: u64, left: &[u8], answers: &[Answer]) -> Vec<Option<usize>> {
    let (folder, server) = (TempDir::new().unwrap(), Server::start(&content(), answers));
    if !left.is_empty() {
        fs::write(folder.path().join("file.hdf5.0123.partial"), left).unwrap();
    }
    let dataset = dataset(&[&server]);
    let LocalDataset { path, sha256 } = fetcher(silence).fetch(&dataset, folder.path()).unwrap();
    assert!(fs::read(&path).unwrap() == content() && dataset.sha256 == Some(sha256));
    assert_eq!(files(&folder), ["file.hdf5"], "nothing else is left");
    server.requests()
}

#[test]
fn a_broken_connection_is_continued_where_it_broke() {
    let other_part =
        "206 Partial Content\r\nContent-Range: bytes 0-200007/200008\r\nContent-Length: 200008";
    let there = Server::start(&content(), &[Send(70_000), WHOLE]);
    let redirect = || status(&format!("302 Found\r\nLocation: {}", there.url));
    for (answers, expected) in [
        (vec![Send(70_000), Send(50_000), WHOLE], vec![None, Some(70_000), Some(120_000)]),
        (
            vec![Send(50_000); 5],
            vec![None, Some(50_000), Some(100_000), Some(150_000), Some(200_000)],
        ),
        (vec![redirect(), redirect()], vec![None, Some(70_000)]),
        // Servers that cannot continue.
        (vec![Send(70_000), page(content())], vec![None, Some(70_000)]),
        (
            vec![Send(70_000), Other(other_part.to_owned(), content()), WHOLE],
            vec![None, Some(70_000), None],
        ),
        (vec![Send(70_000), status("416 No"), WHOLE], vec![None, Some(70_000), None]),
    ] {
        assert_eq!(requests(60, &[], &answers), expected, "{answers:?}");
    }
    assert_eq!(there.requests(), [None, Some(70_000)], "a redirect keeps the range");
}

#[test]
fn a_silent_server_is_left_and_asked_again() {
    assert_eq!(
        requests(5, &[], &[Stall(1_000), Stall(0), WHOLE]),
        [None, Some(1_000), Some(1_000)]
    );
}

#[test]
fn what_an_interrupted_run_has_left_is_continued_if_it_fits() {
    assert_eq!(requests(60, &content()[..70_000], &[WHOLE]), [Some(70_000)]);
    assert_eq!(requests(60, &content(), &[WHOLE]), []);
    assert_eq!(requests(60, &[7; 200_009], &[WHOLE]), [None], "it is larger than the file");
    // What does not fit is found at the end, and costs an address.
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("file.hdf5.0123.partial"), [7; 70_000]).unwrap();
    let servers = [(); 2].map(|()| Server::start(&content(), &[WHOLE]));
    fetch(&dataset(&servers.each_ref()), &folder).unwrap();
    assert_eq!(servers.map(|server| server.requests()), [[Some(70_000)], [None]]);
}

#[test]
fn what_is_not_the_file_is_refused_and_deleted() {
    let sign_in = || page(b"<!DOCTYPE html><title>Sign in</title>".to_vec());
    let chunk = |bytes: Vec<u8>| {
        let body =
            [format!("{:x}\r\n", bytes.len()).into_bytes(), bytes, b"\r\n0\r\n\r\n".to_vec()]
                .concat();
        Other("200 OK\r\nTransfer-Encoding: chunked".to_owned(), body)
    };
    let known = dataset(&[]);
    let unknown = NamedDataset { bytes: None, sha256: None, ..known.clone() };
    let other = NamedDataset { sha256: Some("01234567".repeat(8)), ..known.clone() };
    for (dataset, answer, words, count) in [
        (&known, page(garbage()), "its SHA-256 is", 1),
        (&other, WHOLE, "must be 0123456701234567", 1),
        (&known, sign_in(), "37 bytes, but must have 200008", 1),
        // Where the size is not known in advance, at least the page is.
        (&unknown, sign_in(), "not an HDF5 file", 1),
        (&unknown, chunk(content()), "does not say how large", 1),
        (&known, chunk([b"more".to_vec(), content()].concat()), "not an HDF5 file", 1),
        (&known, chunk(vec![0; 50]), "broke after 50 bytes", 4),
    ] {
        let (folder, server) = (TempDir::new().unwrap(), Server::start(&content(), &[answer]));
        let dataset = NamedDataset { addresses: vec![server.url.clone()], ..dataset.clone() };
        let error = fetch(&dataset, &folder).unwrap_err().to_string();
        assert!(
            error.contains(&server.url) && error.contains(words),
            "{words} is missing in {error}"
        );
        assert!(
            !folder.path().join("file.hdf5").exists() && server.requests().len() >= count,
            "{error}"
        );
        assert!(count > 1 || server.requests().len() == 1, "asking again would not help: {error}");
    }
}

#[test]
fn an_answer_without_the_file_leads_to_the_next_address() {
    for (code, requests) in [("404 No", 1), ("403 No", 1), ("500 No", 4), ("429 No", 4)] {
        let (bad, good) =
            (Server::start(&[], &[status(code)]), Server::start(&content(), &[WHOLE]));
        fetch(&dataset(&[&bad, &good]), &TempDir::new().unwrap()).unwrap();
        assert_eq!((bad.requests().len(), good.requests().len()), (requests, 1), "{code}");
    }
}

#[test]
fn a_mirror_is_asked_first_and_what_it_gave_is_kept() {
    for (answers, others) in
        [(vec![WHOLE], vec![]), (vec![Send(70_000), status("500 No")], vec![Some(70_000)])]
    {
        let (mirror, other) =
            (Server::start(&content(), &answers), Server::start(&content(), &[WHOLE]));
        let fetcher = Fetcher { mirror: Some(mirror.url.replace("file.hdf5", "")), ..fetcher(60) };
        fetcher.fetch(&dataset(&[&other]), TempDir::new().unwrap().path()).unwrap();
        assert_eq!(other.requests(), others);
    }
}

#[test]
fn a_file_in_the_cache_is_verified_and_never_touched() {
    let (folder, server) = (TempDir::new().unwrap(), Server::start(&content(), &[WHOLE]));
    let path = folder.path().join("file.hdf5");
    for (bytes, words) in [(b"\x89HDF".to_vec(), "4 bytes"), (garbage(), "SHA-256")] {
        fs::write(&path, &bytes).unwrap();
        let error = fetch(&dataset(&[&server]), &folder).unwrap_err();
        assert!(error.to_string().contains(words) && fs::read(&path).unwrap() == bytes, "{error}");
    }
    fs::write(&path, content()).unwrap();
    fetch(&dataset(&[&server]), &folder).unwrap();
    assert_eq!((server.requests().len(), files(&folder).len()), (0, 1));
}

#[test]
fn several_runs_that_fetch_the_same_file_at_once_all_have_it() {
    let folder = TempDir::new().unwrap();
    let server = Server::start(&content(), &[Stall(70_000), Send(1_000), WHOLE]);
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
fn offline_the_addresses_are_named() {
    let folder = TempDir::new().unwrap();
    // No server listens at port 9, and the name is reserved for belonging to no host.
    let addresses = ["http://127.0.0.1:9/file.hdf5", "http://nowhere.invalid/file.hdf5"];
    let dataset = NamedDataset { addresses: addresses.map(str::to_owned).into(), ..dataset(&[]) };
    let error = fetch(&dataset, &folder).unwrap_err().to_string();
    assert!(addresses.iter().all(|address| error.contains(&format!("\n  {address}: "))), "{error}");
    assert!(error.contains("refused") && files(&folder).is_empty(), "{error}");
}
