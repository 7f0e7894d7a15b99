//! Tests against servers that cut, lie, redirect, stall and serve garbage.

mod server;

use std::thread;

use tempfile::TempDir;

use super::*;
use server::Answer::{self, Other, Send, Stall};
use server::{Server, WHOLE};

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

fn serve(answers: &[Answer]) -> Server {
    Server::start(&content(), answers)
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

/// Fetches from a server with these answers, into a folder where an interrupted run has left a
/// part; the file must be right in the end. Returns the first byte of each request.
fn requests(silence: u64, left: &[u8], answers: &[Answer]) -> Vec<usize> {
    let (folder, server) = (TempDir::new().unwrap(), serve(answers));
    if !left.is_empty() {
        fs::write(folder.path().join("file.hdf5.0123.partial"), left).unwrap();
    }
    let dataset = dataset(&[&server]);
    let local = fetcher(silence).fetch(&dataset, folder.path()).unwrap();
    assert!(fs::read(&local.path).unwrap() == content());
    assert_eq!(dataset.sha256, Some(local.sha256));
    assert_eq!(files(&folder), ["file.hdf5"], "nothing else is left");
    server.requests()
}

#[test]
fn a_broken_connection_is_continued_where_it_broke() {
    let wrong_part =
        "206 Partial Content\r\nContent-Range: bytes 0-200007/200008\r\nContent-Length: 200008";
    let wrong_part = Other(wrong_part.to_owned(), content());
    let target = serve(&[Send(70_000), WHOLE]);
    let redirect = status(&format!("302 Found\r\nLocation: {}", target.url));
    let fifth = Send(50_000);
    let fifths: &[usize] = &[0, 50_000, 100_000, 150_000, 200_000];
    for (answers, expected) in [
        (vec![fifth.clone(); 5], fifths),
        (vec![Send(70_000), fifth, WHOLE], &[0, 70_000, 120_000]),
        (vec![redirect; 2], &[0, 70_000]),
        // Servers that cannot continue.
        (vec![Send(70_000), page(content())], &[0, 70_000]),
        (vec![Send(70_000), wrong_part, WHOLE], &[0, 70_000, 0]),
        (vec![Send(70_000), status("416 No"), WHOLE], &[0, 70_000, 0]),
    ] {
        assert_eq!(requests(60, &[], &answers), expected, "{answers:?}");
    }
    assert_eq!(target.requests(), [0, 70_000], "a redirect keeps the range");
}

#[test]
fn a_silent_server_is_asked_again() {
    let starts = requests(5, &[], &[Stall(1_000), Stall(0), WHOLE]);
    assert_eq!(starts, [0, 1_000, 1_000]);
}

#[test]
fn the_part_of_an_interrupted_run_is_continued_if_it_fits() {
    assert_eq!(requests(60, &content()[..70_000], &[WHOLE]), [70_000]);
    assert!(requests(60, &content(), &[WHOLE]).is_empty());
    let too_long = [7; 200_009];
    assert_eq!(requests(60, &too_long, &[WHOLE]), [0]);
    // A part of another file is noticed at the end, and costs an address.
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("file.hdf5.0123.partial"), [7; 70_000]).unwrap();
    let servers = [(); 2].map(|()| serve(&[WHOLE]));
    fetch(&dataset(&servers.each_ref()), &folder).unwrap();
    assert_eq!(servers.map(|server| server.requests()), [[70_000], [0]]);
}

#[test]
fn a_wrong_file_is_refused_and_deleted() {
    let sign_in = || page(b"<!DOCTYPE html><title>Sign in</title>".to_vec());
    let chunk = |bytes: &[u8]| {
        let size = format!("{:x}\r\n", bytes.len());
        let body = [size.as_bytes(), bytes, b"\r\n0\r\n\r\n"].concat();
        Other("200 OK\r\nTransfer-Encoding: chunked".to_owned(), body)
    };
    let known = dataset(&[]);
    let (mut unknown, mut other) = (known.clone(), known.clone());
    (unknown.bytes, unknown.sha256) = (None, None);
    other.sha256 = Some("01234567".repeat(8));
    let prefixed = [b"more", &content()[..]].concat();
    for (dataset, answer, words, count) in [
        (&known, page(garbage()), "its SHA-256 is", 1),
        (&other, WHOLE, "must be 0123456701234567", 1),
        (&known, sign_in(), "37 bytes, but must have 200008", 1),
        // The size is not known in advance.
        (&unknown, sign_in(), "not an HDF5 file", 1),
        (&unknown, chunk(&content()), "does not say how large", 1),
        (&known, chunk(&prefixed), "not an HDF5 file", 1),
        (&known, chunk(&[0; 50]), "broke after 50 bytes", 4),
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
fn an_answer_without_the_file_leads_to_the_next_address() {
    for (code, requests) in [("404 No", 1), ("403 No", 1), ("500 No", 4), ("429 No", 4)] {
        let (bad, good) = (serve(&[status(code)]), serve(&[WHOLE]));
        fetch(&dataset(&[&bad, &good]), &TempDir::new().unwrap()).unwrap();
        let counts = [bad, good].map(|server| server.requests().len());
        assert_eq!(counts, [requests, 1], "{code}");
    }
}

#[test]
fn a_mirror_is_tried_first_and_its_part_is_kept() {
    let broken = vec![Send(70_000), status("500 No")];
    for (answers, others) in [(vec![WHOLE], &[][..]), (broken, &[70_000])] {
        let (mirror, other) = (serve(&answers), serve(&[WHOLE]));
        let mut fetcher = fetcher(60);
        fetcher.mirror = Some(mirror.url.replace("file.hdf5", ""));
        let folder = TempDir::new().unwrap();
        fetcher.fetch(&dataset(&[&other]), folder.path()).unwrap();
        assert_eq!(other.requests(), others);
    }
}

#[test]
fn a_page_in_place_of_the_file_costs_no_part() {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("file.hdf5.0123.partial"), &content()[..70_000]).unwrap();
    let (portal, good) = (serve(&[page(b"<!DOCTYPE html>".to_vec())]), serve(&[WHOLE]));
    fetch(&dataset(&[&portal, &good]), &folder).unwrap();
    assert_eq!((portal.requests(), good.requests()), (vec![70_000], vec![70_000]));
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
fn offline_the_error_names_the_addresses() {
    let folder = TempDir::new().unwrap();
    // No server listens at port 9, and the name is reserved for belonging to no host.
    let addresses = ["http://127.0.0.1:9/a.hdf5", "http://nowhere.invalid/a.hdf5"];
    let mut dataset = dataset(&[]);
    dataset.addresses = addresses.map(str::to_owned).into();
    let error = fetch(&dataset, &folder).unwrap_err().to_string();
    for address in addresses {
        assert!(error.contains(&format!("\n  {address}: ")), "{error}");
    }
    assert!(error.contains("refused"), "{error}");
    assert!(files(&folder).is_empty());
}

#[test]
fn a_password_in_an_address_is_not_shown() {
    for (address, shown) in [
        ("http://user:secret@127.0.0.1:9/folder", "http://…@127.0.0.1:9/folder"),
        ("http://user:se/cret@127.0.0.1:9", "http://…@127.0.0.1:9"),
        ("user:secret@127.0.0.1:9/folder", "…@127.0.0.1:9/folder"),
        ("ftp://user:secret@127.0.0.1:9", "ftp://…@127.0.0.1:9"),
        ("http://127.0.0.1:9", "http://127.0.0.1:9"),
    ] {
        assert_eq!(without_password(address), shown);
        let folder = TempDir::new().unwrap();
        let mut fetcher = fetcher(60);
        fetcher.mirror = Some(address.to_owned());
        let error = fetcher.fetch(&dataset(&[]), folder.path()).unwrap_err();
        let text = format!("{error:?}");
        assert!(text.contains(&format!("\n  {shown}/file.hdf5: ")), "{text}");
        assert!(!text.contains("cret"), "{text}");
    }
}
