//! Recorded datasets: a function of the seed, and a faithful replay.

use std::path::{Path, PathBuf};

use quad_dataset::RecordedRows;
use tempfile::TempDir;

use super::*;
use crate::tools::verify::{environment_of, verify};

const TRANSITIONS: usize = 2000;

fn hopper() -> &'static EnvironmentSpec {
    find("hopper").unwrap()
}

fn record(folder: &TempDir, seed: u64, threads: usize) -> (PathBuf, Summary) {
    let path = folder.path().join(format!("{seed}-{threads}.hdf5"));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let summary = pool.unwrap().install(|| collect(hopper(), &path, TRANSITIONS, seed));
    (path, summary.unwrap())
}

fn read(path: &Path) -> RecordedRows {
    RecordedRows::read(path, hopper()).unwrap()
}

#[test]
fn the_file_depends_on_the_seed_and_not_on_the_threads() {
    let folder = tempfile::tempdir().unwrap();
    let rows = |seed, threads| read(&record(&folder, seed, threads).0);
    let two = rows(1, 2);
    assert!(rows(1, 1).iter().eq(two.iter()));
    assert!(!rows(2, 2).iter().eq(two.iter()));
}

#[test]
fn whole_episodes_are_recorded_and_replay_and_changes_are_noticed() {
    let folder = tempfile::tempdir().unwrap();
    let (path, summary) = record(&folder, 3, 2);
    let (transitions, episodes) = (summary.transitions, summary.episodes);
    let rows = read(&path);
    assert!(rows.len() == transitions && transitions >= TRANSITIONS);
    let (mut returns, mut episode_return) = (Vec::new(), 0.0);
    for i in 0..transitions {
        let row = rows.row(i);
        assert!(row.action.iter().all(|value| value.abs() <= 1.0));
        episode_return += row.reward;
        let is_end = row.terminal || row.timeout;
        if is_end {
            returns.push(std::mem::take(&mut episode_return));
        }
        let is_followed =
            i + 1 < transitions && rows.row(i + 1).observation == row.next_observation;
        assert_eq!(is_followed, !is_end, "row {i}");
    }
    assert_eq!(returns.len(), episodes);
    let mean = returns.iter().sum::<f64>() / episodes as f64;
    let best = returns.into_iter().fold(f64::NEG_INFINITY, f64::max);
    let percentiles = summary.score_percentiles;
    assert!(percentiles.is_sorted(), "{percentiles:?}");
    for (score, episode_return) in [(summary.mean_score, mean), (percentiles[3], best)] {
        assert!((score - hopper().normalized_score(episode_return)).abs() < 1e-3, "{score}");
    }

    assert_eq!(environment_of(&path).unwrap(), hopper());
    let report = verify(&path, hopper()).unwrap();
    assert_eq!([report.transitions, report.compared], [transitions; 2]);
    assert_eq!((report.rewards_differ, report.terminals_differ), (0, 0));
    // Float32's rounding; an error of exactly zero would mean that nothing was compared.
    let errors = &report.obs_error;
    assert!((1e-9..1e-6).contains(&errors.median), "{report:?}");
    assert!(errors.p99 < 1e-5, "{report:?}");
    assert!(report.reward_error.max < 1e-3, "{report:?}");

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
    let (algorithm, iteration, seed) = ("changed", 0, 0);
    let metadata = Metadata { algorithm, iteration, seed };
    writer.finish(&metadata).unwrap();
    let report = verify(&changed, hopper()).unwrap();
    assert_eq!((report.rewards_differ, report.terminals_differ), (1, 1));
    for (error, expected) in [(report.reward_error.max, 0.01), (report.obs_error.max, 0.5)] {
        assert!((error - expected).abs() < 1e-4, "{report:?}");
    }
}
