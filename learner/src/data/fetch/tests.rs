//! Against servers that cut, lie, redirect, stall and serve garbage.

mod server;

use std::thread;
use std::time::Instant;

use tempfile::TempDir;

use super::*;
use server::{Answer, Server, status};

/// A small file: HDF5 by its first bytes, and then numbers without a pattern.
fn content() -> Vec<u8> {
    let numbers = (0..200_000_u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8);
    b"\x89HDF\r\n\x1a\n".iter().copied().chain(numbers).collect()
}

/// The same with one byte changed.
fn garbage() -> Vec<u8> {
    let mut bytes = content();
    bytes[150_000] ^= 1;
    bytes
}

/// An answer of these bytes alone, whatever was asked for.
fn page(bytes: Vec<u8>) -> Answer {
    Answer::Other(format!("200 OK\r\nContent-Length: {}", bytes.len()), bytes)
}

fn dataset(addresses: &[&Server]) -> NamedDataset {
    NamedDataset {
        name: "hopper-small-v2".to_owned(),
        environment: "hopper".to_owned(),
        file: "file.hdf5".to_owned(),
        bytes: Some(200_008),
        // From Python: hashlib.sha256(content).
        sha256: "c7c73dfee4b7d79f660f604ecb6967b5ba390f12727b02bb1c336c8277056b1b".to_owned().into(),
        licence: "none".to_owned(),
        addresses: addresses.iter().map(|server| server.url()).collect(),
    }
}

/// How long a server may say nothing that is going to be silent. Others may take a minute, should this machine stand still.
const SILENCE: Duration = Duration::from_secs(2);

/// Tries again after milliseconds where the real one waits for seconds.
fn fetcher(silence: Duration) -> Fetcher {
    Fetcher { client: client(silence), pause: Duration::from_millis(2), mirror: None }
}

fn fetch(dataset: &NamedDataset, folder: &TempDir) -> anyhow::Result<LocalDataset> {
    fetcher(Duration::from_secs(60)).fetch(dataset, folder.path())
}

fn files(folder: &TempDir) -> Vec<String> {
    let names = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.collect()
}

/// What an interrupted run has left.
fn leave(folder: &TempDir, bytes: &[u8]) {
    fs::write(folder.path().join("file.hdf5.0123.partial"), bytes).unwrap();
}

/// Fetches from a server with these answers into a folder; the file must be right in the end. Where each request wanted to
/// start.
fn fetched_into(folder: &TempDir, silence: Duration, answers: &[Answer]) -> Vec<Option<usize>> {
    let server = Server::start(&content(), answers);
    let dataset = dataset(&[&server]);
    let LocalDataset { path, sha256 } = fetcher(silence).fetch(&dataset, folder.path()).unwrap();
    assert!(fs::read(&path).unwrap() == content() && dataset.sha256.matches(&sha256));
    assert_eq!(files(folder), ["file.hdf5"], "nothing else is left");
    server.requests()
}

fn fetched(answers: &[Answer]) -> Vec<Option<usize>> {
    fetched_into(&TempDir::new().unwrap(), Duration::from_secs(60), answers)
}

/// Fetches from a server with this answer, which cannot work: what is said, and how often it was asked.
fn refused(change: impl Fn(&mut NamedDataset), answer: Answer) -> (String, usize) {
    let (folder, server) = (TempDir::new().unwrap(), Server::start(&content(), &[answer]));
    let mut dataset = dataset(&[&server]);
    change(&mut dataset);
    let error = fetch(&dataset, &folder).unwrap_err().to_string();
    assert!(error.contains(&server.url()) && !folder.path().join("file.hdf5").exists(), "{error}");
    (error, server.requests().len())
}

#[test]
fn a_broken_connection_is_resumed_as_long_as_it_goes_forward() {
    let answers = [Answer::Cut(70_000), Answer::Cut(50_000), Answer::Whole];
    assert_eq!(fetched(&answers), [None, Some(70_000), Some(120_000)]);
    let answers = [vec![Answer::Cut(20_000); 10], vec![Answer::Whole]].concat();
    assert_eq!(fetched(&answers).last(), Some(&Some(200_000)), "ten breaks, more than attempts without progress");
}

#[test]
fn a_silent_server_is_left_and_asked_again() {
    let start = Instant::now();
    let answers = [Answer::Stall(1_000), Answer::Stall(0), Answer::Whole];
    let requests = fetched_into(&TempDir::new().unwrap(), SILENCE, &answers);
    assert_eq!(requests, [None, Some(1_000), Some(1_000)]);
    assert!(start.elapsed() < 6 * SILENCE, "two silences of {SILENCE:?} took {:?}", start.elapsed());
}

#[test]
fn a_server_that_cannot_resume_starts_again() {
    assert_eq!(fetched(&[Answer::Cut(70_000), page(content())]), [None, Some(70_000)]);
    let other_part = "206 Partial Content\r\nContent-Range: bytes 0-200007/200008\r\nContent-Length: 200008";
    for answer in [Answer::Other(other_part.to_owned(), content()), status(416)] {
        assert_eq!(fetched(&[Answer::Cut(70_000), answer, Answer::Whole]), [None, Some(70_000), None]);
    }
}

#[test]
fn redirects_keep_the_range() {
    let there = Server::start(&content(), &[Answer::Cut(70_000), Answer::Whole]);
    let redirect = format!("302 Found\r\nLocation: {}\r\nContent-Length: 0", there.url());
    assert_eq!(fetched(&[Answer::Other(redirect, Vec::new())]), [None, Some(70_000)]);
    assert_eq!(there.requests(), [None, Some(70_000)]);
}

#[test]
fn what_is_not_the_file_is_refused_and_deleted() {
    let sign_in = || page(b"<!DOCTYPE html><title>Sign in</title>".to_vec());
    let unknown = |dataset: &mut NamedDataset| (dataset.bytes, dataset.sha256) = (None, Default::default());
    let known = |_: &mut NamedDataset| ();
    let chunk = |bytes: Vec<u8>| {
        let body = [format!("{:x}\r\n", bytes.len()).into_bytes(), bytes, b"\r\n0\r\n\r\n".to_vec()].concat();
        Answer::Other("200 OK\r\nTransfer-Encoding: chunked".to_owned(), body)
    };
    let first_digits = |dataset: &mut NamedDataset| dataset.sha256 = "01234567".to_owned().into();
    for ((reason, requests), words) in [
        (refused(known, page(garbage())), "its SHA-256 is"),
        (refused(first_digits, Answer::Whole), "must be 01234567…"),
        (refused(known, sign_in()), "37 bytes, but must have 200008"),
        // Where the size is not known in advance, at least the page is.
        (refused(unknown, sign_in()), "not an HDF5 file"),
        (refused(unknown, chunk(content())), "does not say how large"),
        (refused(known, chunk([b"more".to_vec(), content()].concat())), "not an HDF5 file"),
    ] {
        assert!(reason.contains(words), "{words} is missing in {reason}");
        assert_eq!(requests, 1, "asking again would not help: {reason}");
    }
    let (reason, requests) = refused(known, chunk(vec![0; 50]));
    assert!(reason.contains("broke after 50 bytes") && requests > 1, "{requests} requests: {reason}");
}

#[test]
fn an_answer_without_the_file_leads_to_the_next_address() {
    for (code, requests) in [(404, 1), (403, 1), (500, 4), (429, 4)] {
        let (bad, good) = (Server::start(&[], &[status(code)]), Server::start(&content(), &[Answer::Whole]));
        fetch(&dataset(&[&bad, &good]), &TempDir::new().unwrap()).unwrap();
        assert_eq!((bad.requests().len(), good.requests().len()), (requests, 1), "{code}");
    }
}

#[test]
fn a_mirror_is_asked_first_and_what_it_gave_is_kept() {
    for (answers, others) in
        [(vec![Answer::Whole], vec![]), (vec![Answer::Cut(70_000), status(500)], vec![Some(70_000)])]
    {
        let (mirror, other) = (Server::start(&content(), &answers), Server::start(&content(), &[Answer::Whole]));
        let mut fetcher = fetcher(SILENCE);
        fetcher.mirror = Some(mirror.url().replace("file.hdf5", ""));
        fetcher.fetch(&dataset(&[&other]), TempDir::new().unwrap().path()).unwrap();
        assert_eq!(other.requests(), others);
    }
}

#[test]
fn what_an_interrupted_run_has_left_is_continued_if_it_fits() {
    for (left, requests) in [
        (&content()[..70_000], &[Some(70_000)][..]),
        (&content(), &[]),
        (&[7; 200_009], &[None]), // Larger than the file.
    ] {
        let folder = TempDir::new().unwrap();
        leave(&folder, left);
        assert_eq!(fetched_into(&folder, SILENCE, &[Answer::Whole]), requests);
    }
    // What does not fit is found at the end, and costs an address.
    let folder = TempDir::new().unwrap();
    leave(&folder, &[7; 70_000]);
    let servers = [(); 2].map(|()| Server::start(&content(), &[Answer::Whole]));
    fetch(&dataset(&servers.each_ref()), &folder).unwrap();
    assert_eq!(servers.map(|server| server.requests()), [[Some(70_000)], [None]]);
}

#[test]
fn a_file_in_the_cache_is_verified_and_never_touched() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("file.hdf5");
    let server = Server::start(&content(), &[Answer::Whole]);
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
    let server = Server::start(&content(), &[Answer::Stall(70_000), Answer::Cut(1_000), Answer::Whole]);
    let dataset = dataset(&[&server]);
    thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| fetcher(SILENCE).fetch(&dataset, folder.path()).unwrap());
        }
    });
    assert!(fs::read(folder.path().join("file.hdf5")).unwrap() == content());
    assert_eq!(files(&folder), ["file.hdf5"]);
}

#[test]
fn offline_the_addresses_and_the_place_are_named() {
    let folder = TempDir::new().unwrap();
    // No server listens at port 9, and the name is reserved for belonging to no host.
    let addresses = ["http://127.0.0.1:9/file.hdf5", "http://nowhere.invalid/file.hdf5"];
    let dataset = NamedDataset { addresses: addresses.map(str::to_owned).into(), ..dataset(&[]) };
    let error = fetch(&dataset, &folder).unwrap_err().to_string();
    assert!(addresses.iter().all(|address| error.contains(&format!("\n  {address}: "))), "{error}");
    assert!(error.contains("refused") && files(&folder).is_empty(), "{error}");
}
