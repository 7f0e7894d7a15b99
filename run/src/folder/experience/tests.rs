//! Tests of `experience.log`.

use std::fs;
use std::path::PathBuf;

use quad_protocol::{EpisodeScore, Name, encode};
use tempfile::TempDir;

use super::*;
use crate::fixtures::config;

/// An online episode of two steps.
pub(crate) fn episode(seed: u64) -> Episode {
    Episode {
        score: EpisodeScore { seed, episode_return: 3.0, length: 2, score: 3.0 },
        observations: vec![0.0, 1.0, 2.0],
        actions: vec![0.5, -0.5],
        rewards: vec![1.0, 2.0],
        ..Episode::new(10, Hash::new(b"weights"), Name::new("f32").unwrap(), seed)
    }
}

fn frame(seed: u64) -> Vec<u8> {
    encode(&episode(seed)).unwrap()
}

/// A run with the records of seeds 1, 2 and 3, the path of their file, and its contents.
fn recorded() -> (TempDir, RunDir, PathBuf, Vec<u8>) {
    let folder = tempfile::tempdir().unwrap();
    let (run, _) = RunDir::create(&folder.path().join("a"), &config("a", 0)).unwrap();
    assert_eq!(read_experience(run.path()).unwrap(), []);
    let (mut log, records) = run.experience_log().unwrap();
    assert_eq!(records, []);
    for seed in 1..=3 {
        log.append([&*frame(seed)]).unwrap();
    }
    let path = run.path().join("experience.log");
    let bytes = fs::read(&path).unwrap();
    (folder, run, path, bytes)
}

#[test]
fn an_incomplete_record_at_the_end_is_cut_off() {
    let (_folder, run, path, bytes) = recorded();
    let record_length = bytes.len() / 3;
    for kept in [0, 1, 35, 36, 40, record_length - 1] {
        fs::write(&path, &bytes[..2 * record_length + kept]).unwrap();
        assert_eq!(read_experience(run.path()).unwrap(), [1, 2].map(episode));
        let (mut log, records) = run.experience_log().unwrap();
        assert_eq!(records, [1, 2].map(|seed| (Hash::new(&frame(seed)), episode(seed))));
        log.append([&*frame(3)]).unwrap();
        assert_eq!(fs::read(&path).unwrap(), bytes, "{kept} bytes");
    }
}

#[test]
fn a_damaged_record_before_another_one_is_an_error() {
    let (_folder, run, path, bytes) = recorded();
    let start = bytes.len() / 3;
    // In length, hash, begin and end of the frame of the second.
    for offset in [0, 3, 4, 36, start - 1] {
        let mut damaged = bytes.clone();
        damaged[start + offset] ^= 0x40;
        fs::write(&path, &damaged).unwrap();
        let error = run.experience_log().unwrap_err();
        let words = format!("record 2, at byte {start}, is damaged, but one after it is complete");
        assert!(error.to_string().ends_with(&words), "{offset}: {error}");
        assert!(error.hint().contains("a copy of the file"));
        assert!(read_experience(run.path()).is_err());
        assert_eq!(fs::read(&path).unwrap(), damaged);
    }
}

/// After a power cut, a later part of what was not synchronized may be there without an earlier.
#[test]
fn a_torn_append_is_cut_off_from_its_first_damaged_record_on() {
    let (_folder, run, path, bytes) = recorded();
    let mut log = run.experience_log().unwrap().0;
    log.append([4, 5, 6].map(frame).iter().map(Vec::as_slice)).unwrap();
    let whole = fs::read(&path).unwrap();
    assert_eq!(read_experience(run.path()).unwrap(), [1, 2, 3, 4, 5, 6].map(episode));
    let length = bytes.len() / 3;
    for (torn, kept) in [(3, 3), (4, 4), (5, 5)] {
        for range in [0..1, 10..60, length - 20..length, 0..length] {
            let mut damaged = whole.clone();
            damaged[torn * length..][range].fill(0);
            fs::write(&path, damaged).unwrap();
            let episodes = Vec::from_iter((1..=kept).map(episode));
            assert_eq!(read_experience(run.path()).unwrap(), episodes);
            drop(run.experience_log().unwrap());
            assert_eq!(fs::read(&path).unwrap().len(), kept as usize * length);
        }
    }
}

#[test]
fn the_log_of_a_program_of_another_version_is_read_but_no_other_message() {
    let (_folder, run, path, _) = recorded();
    // A byte of the version, and the kind.
    for (byte, expected) in
        [(4, Ok(vec![episode(4)])), (6, Err("is of kind 6, kind 7 belongs here"))]
    {
        let mut frame = frame(4);
        frame[byte] ^= 1;
        fs::remove_file(&path).unwrap();
        run.experience_log().unwrap().0.append([&*frame]).unwrap();
        let read = read_experience(run.path()).map_err(|error| error.to_string());
        match expected {
            Ok(episodes) => assert_eq!(read.unwrap(), episodes),
            Err(words) => assert!(read.unwrap_err().contains(words)),
        }
    }
}
