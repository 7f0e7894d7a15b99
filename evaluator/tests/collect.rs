//! A recorded dataset: the same for the same seed, true to the simulation, and what replaying it
//! finds.
#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};

use quad_dataset::environment::find;
use quad_dataset::{D4rlWriter, EnvironmentSpec, Metadata, RecordedRows};
use quad_evaluator::tools::collect::{Summary, collect};
use quad_evaluator::tools::verify::{environment_of, verify};
use tempfile::TempDir;

const TRANSITIONS: usize = 2000;

fn hopper() -> &'static EnvironmentSpec {
    find("hopper").unwrap()
}

fn record(folder: &TempDir, seed: u64, threads: usize) -> (PathBuf, Summary) {
    let path = folder.path().join(format!("{seed}-{threads}.hdf5"));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let summary = pool.install(|| collect(hopper(), &path, TRANSITIONS, seed)).unwrap();
    (path, summary)
}

fn read(path: &Path) -> RecordedRows {
    RecordedRows::read(path, hopper()).unwrap()
}

#[test]
fn the_seed_makes_the_file_and_the_threads_do_not() {
    let folder = tempfile::tempdir().unwrap();
    let (one, two, other) = (record(&folder, 1, 1), record(&folder, 1, 2), record(&folder, 2, 2));
    assert!(read(&one.0).iter().eq(read(&two.0).iter()));
    assert!(!read(&two.0).iter().eq(read(&other.0).iter()));
}

#[test]
fn whole_episodes_are_recorded_that_replay_and_a_change_is_noticed() {
    let folder = tempfile::tempdir().unwrap();
    let (path, summary) = record(&folder, 3, 2);
    let rows = read(&path);
    assert_eq!(rows.len(), summary.transitions);
    assert!(rows.len() >= TRANSITIONS);
    assert_eq!(rows.iter().filter(|row| row.terminal || row.timeout).count(), summary.episodes);
    assert!(rows.row(rows.len() - 1).terminal || rows.row(rows.len() - 1).timeout);
    for i in 1..rows.len() {
        let (before, row) = (rows.row(i - 1), rows.row(i));
        let in_episode = !(before.terminal || before.timeout);
        assert_eq!(before.next_observation == row.observation, in_episode, "row {i}");
        assert!(row.action.iter().all(|value| value.abs() <= 1.0));
    }
    let total: f64 = rows.iter().map(|row| row.reward).sum();
    let mean_score = hopper().normalized_score(total / summary.episodes as f64);
    assert!((summary.mean_score - mean_score).abs() < 1e-3, "{} {mean_score}", summary.mean_score);

    assert_eq!(environment_of(&path).unwrap(), hopper(), "it says so itself");
    let report = verify(&path, hopper()).unwrap();
    assert_eq!((report.transitions, report.compared), (summary.transitions, summary.transitions));
    assert_eq!((report.rewards_differ, report.terminals_differ), (0, 0));
    // Nothing but float32's rounding, which is there: an error of exactly zero would mean that
    // nothing was compared.
    assert!(report.obs_error.median > 1e-9 && report.obs_error.median < 1e-6, "{report:?}");
    assert!(report.obs_error.p99 < 1e-5 && report.reward_error.max < 1e-3, "{report:?}");

    let changed = folder.path().join("changed.hdf5");
    let mut writer = D4rlWriter::create(&changed, hopper()).unwrap();
    for (i, mut row) in rows.iter().enumerate() {
        let mut next_observation = row.next_observation.to_vec();
        match i {
            10 => row.reward += 0.01,
            20 => row.terminal = !row.terminal,
            30 => next_observation[4] += 0.5,
            _ => {}
        }
        row.next_observation = &next_observation;
        writer.push(&row).unwrap();
    }
    writer.finish(&Metadata { algorithm: "changed", iteration: 0, seed: 0 }).unwrap();
    let report = verify(&changed, hopper()).unwrap();
    assert_eq!((report.rewards_differ, report.terminals_differ), (1, 1));
    assert!(
        (report.reward_error.max - 0.01).abs() < 1e-4 && (report.obs_error.max - 0.5).abs() < 1e-4,
        "{report:?}"
    );
}
