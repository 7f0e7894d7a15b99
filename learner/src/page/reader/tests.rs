//! Tests of `page/reader.rs`.

use std::fs;

use serde_json::json;

use super::*;
use crate::fixtures::{config, line};

#[test]
fn a_run_that_took_the_folder_of_another_is_shown_alone() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("run");
    let mut page = RunPage::of(&dir);
    for (started, steps) in [(1, 3), (2, 4)] {
        let mut config = config("run", started);
        config.run.started = started;
        let (_, mut scores) = RunDir::create(&dir, &config).unwrap();
        scores.append(&[line(100 * steps, 1, 10.0)]).unwrap();
        let metrics = (1..=steps)
            .map(|n| format!("{{\"step\":{},\"seconds\":{n}.0,\"loss\":{started}.0}}\n", 100 * n));
        fs::write(dir.join("metrics.jsonl"), metrics.collect::<String>()).unwrap();
        let shown = page.read().unwrap();
        let rows = shown["history"]["rows"].as_array().unwrap();
        assert_eq!(rows.len(), steps as usize, "{rows:?}");
        assert!(rows.iter().all(|row| row[2] == json!(started as f64)), "{rows:?}");
        RunDir::at(&dir).set_aside().unwrap();
    }
}

#[test]
fn of_many_episodes_the_newest_are_shown() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("run");
    let (_, mut scores) = RunDir::create(&dir, &config("run", 1)).unwrap();
    scores.append(&Vec::from_iter((1..=25).map(|n| line(100 * n, 1, n as f64)))).unwrap();
    let shown = RunPage::of(&dir).read().unwrap();
    let steps =
        shown["episodes"].as_array().unwrap().iter().map(|one| one["step"].as_u64().unwrap());
    assert_eq!(Vec::from_iter(steps), Vec::from_iter((6..=25).map(|n| 100 * n)));
}
