//! Tests of `report/tensorboard.rs`. That TensorBoard reads the files is tested in python/tests.

use std::fs::OpenOptions;

use quad_runs::run::RunDir;

use super::*;
use crate::fixtures::{config, line};

/// A run of two episodes an evaluation, and a folder for event files.
struct Fixture {
    folder: tempfile::TempDir,
    run: PathBuf,
}

impl Fixture {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("a");
        RunDir::create(&run, &config("a", 0)).unwrap();
        Self { folder, run }
    }

    fn events(&self) -> PathBuf {
        self.folder.path().join("events")
    }

    fn exporter(&self) -> Exporter {
        Exporter::new(&self.run, &self.events())
    }

    fn append(&self, name: &str, text: &str) {
        let mut file = OpenOptions::new().create(true).append(true).open(self.run.join(name)).unwrap();
        file.write_all(text.as_bytes()).unwrap();
    }

    fn score(&self, step: u64, seeds: &[u64]) {
        let lines = seeds.iter().map(|seed| serde_json::to_string(&line(step, *seed, *seed as f64)).unwrap() + "\n");
        self.append("scores.jsonl", &lines.collect::<String>());
    }

    /// Each scalar of the event file of the run, as time, step, tag and value.
    fn scalars(&self) -> Vec<(f64, u8, String, f32)> {
        let mut files = event_files(&self.events().join("a")).unwrap();
        let bytes = fs::read(files.pop().unwrap()).unwrap();
        assert!(files.len() < 2 && files.iter().all(|file| fs::read(file).unwrap().is_empty()), "{files:?}");
        let mut rest = &bytes[..];
        let mut found = Vec::new();
        while !rest.is_empty() {
            let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            let event = &rest[12..12 + length];
            assert_eq!(
                (&rest[8..12], &rest[12 + length..16 + length]),
                (&checksum(&rest[..8])[..], &checksum(event)[..])
            );
            rest = &rest[16 + length..];
            let time = f64::from_le_bytes(event[1..9].try_into().unwrap());
            // Behind the time and a step that takes one byte; then the summary's tag and length, and its values.
            let mut values = if event[11] == 0x2a { &event[13..] } else { &[] };
            while !values.is_empty() {
                let tag = &values[4..4 + values[3] as usize];
                let value = f32::from_le_bytes(values[5 + tag.len()..9 + tag.len()].try_into().unwrap());
                found.push((time, event[10], String::from_utf8(tag.to_vec()).unwrap(), value));
                values = &values[9 + tag.len()..];
            }
        }
        found
    }

    /// The steps of a series.
    fn steps(&self, tag: &str) -> Vec<u8> {
        self.scalars().into_iter().filter(|scalar| scalar.2 == tag).map(|scalar| scalar.1).collect()
    }
}

#[test]
fn records_are_those_of_the_format() {
    // The first twelve bytes of every event file that TensorFlow writes.
    let version = [&[0x09][..], &1.0f64.to_le_bytes(), &field(0x1a, b"brain.Event:2")].concat();
    let length = (version.len() as u64).to_le_bytes();
    assert_eq!((length[0], checksum(&length)), (0x18, [0xa3, 0x7f, 0x4b, 0x22]));
    assert_eq!((varint(127), varint(300)), (vec![127], vec![0xac, 0x02]));
}

#[test]
fn what_a_run_writes_is_appended_and_half_a_line_waits_for_its_rest() {
    let fixture = Fixture::new();
    let mut exporter = fixture.exporter();
    exporter.append().unwrap();
    assert_eq!(fixture.scalars(), []);

    fixture.append("metrics.jsonl", "{\"step\":10,\"seconds\":2.5,\"loss\":0.5,\"q\":-1.0}\n{\"step\":20,\"sec");
    fixture.score(10, &[1, 3]);
    fixture.score(20, &[1]);
    exporter.append().unwrap();
    // The run was started a millisecond after 1970 began.
    let first = [("train/loss", 0.5), ("train/q", -1.0)];
    let scored = [
        ("evaluation/score", 2.0),
        ("evaluation/score_std", 2f32.sqrt()),
        ("evaluation/return", 20.0),
        ("evaluation/length", 5.0),
    ];
    let expected = first.iter().chain(&scored).map(|(tag, value)| (2.501, 10, (*tag).to_owned(), *value));
    let expected = Vec::from_iter(expected);
    assert_eq!(fixture.scalars(), expected);
    exporter.append().unwrap();
    assert_eq!(fixture.scalars(), expected, "nothing is written twice");

    fixture.append("metrics.jsonl", "onds\":5.0,\"loss\":0.25,\"q\":0.0}\n");
    fixture.score(20, &[3]);
    exporter.append().unwrap();
    assert_eq!(fixture.scalars()[..expected.len()], expected);
    assert_eq!((fixture.steps("train/loss"), fixture.steps("evaluation/score")), (vec![10, 20], vec![10, 20]));
}

#[test]
fn a_run_that_goes_on_from_a_checkpoint_has_each_step_once() {
    let fixture = Fixture::new();
    let row = |step: u64| format!("{{\"step\":{step},\"seconds\":{step},\"loss\":0.5}}\n");
    fixture.append("metrics.jsonl", &(row(10) + &row(20) + &row(30)));
    fixture.exporter().append().unwrap();
    assert_eq!(fixture.steps("train/loss"), [10, 20, 30]);
    drop(RunDir::at(&fixture.run).metrics_log(20).unwrap());
    fixture.append("metrics.jsonl", &row(25));
    for _ in 0..2 {
        std::thread::sleep(Duration::from_millis(2));
        fixture.exporter().append().unwrap();
        assert_eq!(fixture.steps("train/loss"), [10, 20, 25]);
    }
}

#[test]
fn a_late_evaluation_begins_the_file_anew_and_so_does_a_file_that_is_not_as_it_was() {
    let fixture = Fixture::new();
    let mut exporter = fixture.exporter();
    fixture.append("metrics.jsonl", "{\"step\":10,\"seconds\":1.0,\"loss\":0.5}\n");
    fixture.score(10, &[0]);
    fixture.score(20, &[0, 1]);
    exporter.append().unwrap();
    assert_eq!(fixture.steps("evaluation/score"), [20]);
    fixture.score(10, &[1]);
    let mut append = || {
        std::thread::sleep(Duration::from_millis(2));
        exporter.append().unwrap();
        assert_eq!((fixture.steps("train/loss"), fixture.steps("evaluation/score")), (vec![10], vec![10, 20]));
    };
    append();
    fs::remove_dir_all(fixture.events()).unwrap();
    append();
    // A report, while the learner is at work.
    std::thread::sleep(Duration::from_millis(2));
    fixture.exporter().append().unwrap();
    append();
}
