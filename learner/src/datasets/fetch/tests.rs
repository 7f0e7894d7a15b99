//! Against servers that cut, lie, redirect, stall and serve garbage.

mod server;

use std::process::Command;
use std::thread;
use std::time::Instant;

use tempfile::TempDir;

use super::*;
use server::{Answer, Server};

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

fn dataset(addresses: &[&str]) -> NamedDataset {
    NamedDataset {
        name: "hopper-small-v2".to_owned(),
        environment: "hopper".to_owned(),
        file: "file.hdf5".to_owned(),
        bytes: Some(200_008),
        // From Python: hashlib.sha256(content).
        sha256: "c7c73dfee4b7d79f660f604ecb6967b5ba390f12727b02bb1c336c8277056b1b".to_owned().into(),
        licence: "none".to_owned(),
        addresses: addresses.iter().map(|&address| address.to_owned()).collect(),
    }
}

/// How long a server may say nothing that is going to be silent. Others may take a minute, should this machine stand still.
const SILENCE: Duration = Duration::from_secs(2);

fn fetcher(mirror: Option<&str>) -> Fetcher {
    fetcher_with(mirror, Duration::from_secs(60))
}

/// Tries again after milliseconds where the real one waits for seconds.
fn fetcher_with(mirror: Option<&str>, silence: Duration) -> Fetcher {
    let patience = Patience { connect: Duration::from_secs(60), silence };
    let delays = ExponentialBuilder::new().with_min_delay(Duration::from_millis(2)).with_max_times(3);
    Fetcher { client: client(patience), delays, mirror: mirror.map(str::to_owned) }
}

fn files(folder: &Path) -> Vec<String> {
    let names = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<_> = names.collect();
    names.sort();
    names
}

/// Fetches from a server with these answers; the file must be right in the end. Where each request wanted to start.
fn fetched(answers: &[Answer]) -> Vec<Option<usize>> {
    fetched_by(&fetcher(None), answers)
}

fn fetched_by(fetcher: &Fetcher, answers: &[Answer]) -> Vec<Option<usize>> {
    let (folder, server) = (TempDir::new().unwrap(), Server::start(&content(), answers));
    let dataset = dataset(&[&server.url()]);
    let (path, sha256) = fetcher.fetch(&dataset, folder.path()).unwrap();
    assert_eq!((fs::read(&path).unwrap() == content(), dataset.sha256.matches(&sha256)), (true, true));
    assert_eq!(files(folder.path()), ["file.hdf5"], "nothing else is left");
    server.requests()
}

/// Fetches from a server with these answers, which cannot work: what is said of its address, and how often it was asked.
/// Nothing may be left but perhaps a partial file.
fn refused(dataset: NamedDataset, answers: &[Answer]) -> (String, usize) {
    let (folder, server) = (TempDir::new().unwrap(), Server::start(&content(), answers));
    let dataset = NamedDataset { addresses: vec![server.url()], ..dataset };
    let error = fetcher(None).fetch(&dataset, folder.path()).unwrap_err();
    assert!(!folder.path().join("file.hdf5").exists());
    let FetchError::Unavailable { refusals, .. } = &error else { panic!("{error}") };
    assert_eq!(refusals[0].0, server.url());
    (refusals[0].1.to_string(), server.requests().len())
}

#[test]
fn a_broken_connection_is_resumed_where_it_broke() {
    let answers = [Answer::Cut(70_000), Answer::Cut(50_000), Answer::Whole];
    assert_eq!(fetched(&answers), [None, Some(70_000), Some(120_000)]);
}

#[test]
fn a_connection_that_breaks_often_is_resumed_as_long_as_it_goes_forward() {
    let answers = [vec![Answer::Cut(20_000); 10], vec![Answer::Whole]].concat();
    assert_eq!(fetched(&answers).last(), Some(&Some(200_000)), "ten breaks, and an attempt is repeated three times");
}

#[test]
fn a_silent_server_is_left_and_asked_again() {
    let start = Instant::now();
    let requests = fetched_by(&fetcher_with(None, SILENCE), &[Answer::Stall(1_000), Answer::Stall(0), Answer::Whole]);
    assert_eq!(requests, [None, Some(1_000), Some(1_000)]);
    assert!(start.elapsed() < 6 * SILENCE, "two silences of {SILENCE:?} took {:?}", start.elapsed());
}

#[test]
fn a_server_that_cannot_resume_starts_again() {
    assert_eq!(fetched(&[Answer::Cut(70_000), Answer::NoRanges]), [None, Some(70_000)]);
    assert_eq!(fetched(&[Answer::Cut(70_000), Answer::WrongRange, Answer::Whole]), [None, Some(70_000), None]);
    assert_eq!(fetched(&[Answer::Cut(70_000), Answer::Status(416), Answer::Whole]), [None, Some(70_000), None]);
}

#[test]
fn redirects_are_followed_and_keep_the_range() {
    let there = Server::start(&content(), &[Answer::Cut(70_000), Answer::Whole]);
    assert_eq!(fetched(&[Answer::Redirect(there.url())]), [None, Some(70_000)]);
    assert_eq!(there.requests(), [None, Some(70_000)]);
    let folder = TempDir::new().unwrap();
    let circle = Server::start(&[], &[Answer::Redirect("/file.hdf5".to_owned())]);
    let error = fetcher(None).fetch(&dataset(&[&circle.url()]), folder.path()).unwrap_err().to_string();
    assert!(error.contains("redirects") && circle.requests().len() < 20, "{error}, {}", circle.requests().len());
}

#[test]
fn a_server_that_lies_about_the_size_is_refused() {
    for (length, words) in [(100, "100 bytes, but must have 200008"), (200_009, "200009 bytes, but must have 200008")] {
        let (reason, requests) = refused(dataset(&[]), &[Answer::Bytes(content(), length)]);
        assert!(reason.contains(words), "{reason}");
        assert_eq!(requests, 1, "asking again would not help");
    }
    let (reason, _) = refused(dataset(&[]), &[Answer::Chunk([content(), vec![0]].concat())]);
    assert!(reason.contains("more than the file's 200008 bytes"), "{reason}");
    let (reason, requests) = refused(dataset(&[]), &[Answer::Chunk(vec![0; 50])]);
    assert!(reason.contains("broke after 50 bytes"), "{reason}");
    assert!(requests > 1, "a connection that breaks is tried again");
}

#[test]
fn garbage_is_deleted() {
    let (reason, requests) = refused(dataset(&[]), &[Answer::Bytes(garbage(), 200_008)]);
    assert!(reason.contains("SHA-256") && reason.contains("c7c73dfe"), "{reason}");
    assert_eq!(requests, 1);
    let page = b"<!DOCTYPE html><title>We are sorry</title>".to_vec();
    let (reason, _) = refused(dataset(&[]), &[Answer::Bytes(page.clone(), page.len())]);
    assert!(reason.contains("42 bytes"), "{reason}");
    // Where the size is not known, at least the page is.
    let unknown = NamedDataset { bytes: None, sha256: Default::default(), ..dataset(&[]) };
    let (reason, _) = refused(unknown.clone(), &[Answer::Bytes(page.clone(), page.len())]);
    assert!(reason.contains("not an HDF5 file"), "{reason}");
    let (reason, _) = refused(unknown, &[Answer::Chunk(content())]);
    assert!(reason.contains("does not say how large"), "{reason}");
}

#[test]
fn only_the_first_digits_of_a_checksum_may_be_known() {
    let first = |digits: &str| NamedDataset { sha256: digits.to_owned().into(), ..dataset(&[]) };
    let (reason, _) = refused(first("01234567"), &[Answer::Whole]);
    assert!(reason.contains("must be 01234567…"), "{reason}");
    let (folder, server) = (TempDir::new().unwrap(), Server::start(&content(), &[Answer::Whole]));
    let dataset = NamedDataset { addresses: vec![server.url()], ..first("c7c73dfe") };
    fetcher(None).fetch(&dataset, folder.path()).unwrap();
}

#[test]
fn an_answer_without_the_file_leads_to_the_next_address() {
    for (status, requests) in [(404, 1), (403, 1), (500, 4), (503, 4), (429, 4)] {
        let folder = TempDir::new().unwrap();
        let bad = Server::start(&content(), &[Answer::Status(status)]);
        let good = Server::start(&content(), &[Answer::Whole]);
        fetcher(None).fetch(&dataset(&[&bad.url(), &good.url()]), folder.path()).unwrap();
        assert_eq!((bad.requests().len(), good.requests().len()), (requests, 1), "{status}");
    }
}

#[test]
fn a_mirror_is_asked_first_and_only_what_it_lacks_elsewhere() {
    let folder = TempDir::new().unwrap();
    let (mirror, other) = (Server::start(&content(), &[Answer::Whole]), Server::start(&content(), &[Answer::Whole]));
    let base = mirror.url().replace("file.hdf5", "");
    fetcher(Some(&base)).fetch(&dataset(&[&other.url()]), folder.path()).unwrap();
    assert_eq!((mirror.requests().len(), other.requests().len()), (1, 0));

    let folder = TempDir::new().unwrap();
    let failing = Server::start(&content(), &[Answer::Cut(70_000), Answer::Status(500)]);
    fetcher(Some(&failing.url().replace("/file.hdf5", ""))).fetch(&dataset(&[&other.url()]), folder.path()).unwrap();
    assert_eq!(other.requests(), [Some(70_000)], "what the mirror gave is kept");
}

#[test]
fn what_another_address_left_is_forgotten_if_it_does_not_fit() {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("file.hdf5.partial"), [7; 70_000]).unwrap();
    let server = Server::start(&content(), &[Answer::Whole]);
    fetcher(None).fetch(&dataset(&[&server.url()]), folder.path()).unwrap();
    assert_eq!(server.requests(), [Some(70_000), None]);

    // Larger than the file, or whole and wrong.
    for left in [vec![7; 200_009], garbage()] {
        let folder = TempDir::new().unwrap();
        fs::write(folder.path().join("file.hdf5.partial"), left).unwrap();
        let server = Server::start(&content(), &[Answer::Whole]);
        fetcher(None).fetch(&dataset(&[&server.url()]), folder.path()).unwrap();
        assert_eq!(server.requests(), [None]);
    }
}

#[test]
fn a_partial_file_that_is_whole_needs_no_server() {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("file.hdf5.partial"), content()).unwrap();
    let server = Server::start(&content(), &[Answer::Status(500)]);
    fetcher(None).fetch(&dataset(&[&server.url()]), folder.path()).unwrap();
    assert_eq!((server.requests().len(), files(folder.path())), (0, vec!["file.hdf5".to_owned()]));
}

#[test]
fn a_file_in_the_cache_is_verified_and_never_touched() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("file.hdf5");
    let server = Server::start(&content(), &[Answer::Whole]);
    let dataset = dataset(&[&server.url()]);
    for (bytes, words) in [(b"\x89HDF".to_vec(), "4 bytes"), (garbage(), "SHA-256")] {
        fs::write(&path, &bytes).unwrap();
        let error = fetcher(None).fetch(&dataset, folder.path()).unwrap_err();
        assert!(error.to_string().contains(words) && error.hint().contains("move it away"), "{error}");
        assert!(fs::read(&path).unwrap() == bytes);
    }
    fs::write(&path, content()).unwrap();
    fetcher(None).fetch(&dataset, folder.path()).unwrap();
    assert_eq!((server.requests().len(), files(folder.path()).len()), (0, 1));
}

#[test]
fn several_that_want_the_same_file_fetch_it_once() {
    let folder = TempDir::new().unwrap();
    let server = Server::start(&content(), &[Answer::Stall(70_000), Answer::Whole]);
    let dataset = dataset(&[&server.url()]);
    thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| fetcher_with(None, SILENCE).fetch(&dataset, folder.path()).unwrap());
        }
    });
    assert_eq!(server.requests(), [None, Some(70_000)]);
    assert_eq!(
        (fs::read(folder.path().join("file.hdf5")).unwrap() == content(), files(folder.path()).len()),
        (true, 1)
    );
}

#[test]
fn several_that_want_what_nobody_has_all_say_so() {
    let folder = TempDir::new().unwrap();
    let server = Server::start(&content(), &[Answer::Stall(0), Answer::Status(404)]);
    let dataset = dataset(&[&server.url()]);
    thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| fetcher_with(None, SILENCE).fetch(&dataset, folder.path()).unwrap_err());
        }
    });
    assert_eq!(files(folder.path()), [""; 0]);
}

#[test]
fn offline_the_addresses_and_the_place_are_named() {
    let folder = TempDir::new().unwrap();
    // Nobody listens at port 9, and the name is reserved for belonging to nobody.
    let addresses = ["http://127.0.0.1:9/file.hdf5", "http://nowhere.invalid/file.hdf5"];
    let error = fetcher(None).fetch(&dataset(&addresses), folder.path()).unwrap_err();
    let (text, hint) = (error.to_string(), error.hint());
    assert!(addresses.iter().all(|address| text.contains(&format!("\n  {address}: "))), "{text}");
    assert!(text.contains("refused"), "{text}");
    let place = folder.path().join("file.hdf5");
    assert!(hint.contains(place.to_str().unwrap()) && hint.contains("QUAD_DATASETS_URL"), "{hint}");
    assert_eq!(files(folder.path()), [""; 0]);
}

/// A small file system in memory, unmounted when dropped.
struct SmallDisk(TempDir);

impl SmallDisk {
    fn mount(options: &str) -> Option<Self> {
        let folder = TempDir::new().unwrap();
        let mount = Command::new("mount").args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(folder.path()).output();
        match mount {
            Ok(output) if output.status.success() => Some(Self(folder)),
            _ => {
                eprintln!("skipped: mounting a tmpfs needs the rights of root");
                None
            }
        }
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        Command::new("umount").arg(self.0.path()).status().ok();
    }
}

#[test]
fn a_full_disk_is_said_to_be_full() {
    let Some(disk) = SmallDisk::mount("size=100k") else { return };
    let server = Server::start(&content(), &[Answer::Whole]);
    let error = fetcher(None).fetch(&dataset(&[&server.url()]), disk.0.path()).unwrap_err();
    let text = format!("{error}: {}", std::error::Error::source(&error).unwrap());
    assert!(text.contains("No space left") && text.contains(disk.0.path().to_str().unwrap()), "{text}");
    assert!(error.hint().contains("make room"), "{}", error.hint());
    assert_eq!(server.requests().len(), 1, "no address can mend that");
    assert_eq!(files(disk.0.path()), ["file.hdf5.partial"]);
}

#[test]
fn a_folder_that_cannot_be_written_to_is_named() {
    let Some(disk) = SmallDisk::mount("ro") else { return };
    let server = Server::start(&content(), &[Answer::Whole]);
    for folder in [disk.0.path().to_owned(), disk.0.path().join("datasets")] {
        let error = fetcher(None).fetch(&dataset(&[&server.url()]), &folder).unwrap_err();
        assert!(error.to_string().contains(folder.to_str().unwrap()), "{error}");
        assert!(error.hint().contains("D4RL_DATASET_DIR"), "{}", error.hint());
    }
    assert_eq!(server.requests().len(), 0);
}
