//! Tests of `page/reader.rs`.

use std::fs;

use super::*;
use crate::fixtures::{config, line};

#[test]
fn a_new_run_in_the_same_folder_is_shown_alone() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("run");
    let mut page = RunPage::of(&dir);
    for (started, steps) in [(1, 3), (2, 4)] {
        let mut config = config("run", started);
        config.run.started = started;
        RunDir::create(&dir, &config).unwrap();
        let mut metrics = String::new();
        for step in 1..=steps {
            metrics += &format!("{{\"step\":{step},\"seconds\":{step}.0,\"loss\":{started}.0}}\n");
        }
        fs::write(dir.join("metrics.jsonl"), metrics).unwrap();
        let shown = page.read().unwrap();
        let rows = shown["history"]["rows"].as_array().unwrap();
        assert_eq!(rows.len(), steps);
        assert!(rows.iter().all(|row| row[2] == started as f64), "{rows:?}");
        RunDir::at(&dir).set_aside().unwrap();
    }
}

#[test]
fn the_newest_episodes_are_shown() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("run");
    let (_, mut scores) = RunDir::create(&dir, &config("run", 1)).unwrap();
    scores.append(&Vec::from_iter((1..=25).map(|n| line(100 * n, 1, n as f64)))).unwrap();
    let shown = RunPage::of(&dir).read().unwrap();
    let steps = shown["episodes"].as_array().unwrap().iter().map(|episode| &episode["step"]);
    assert!(steps.eq(&Vec::from_iter((6..=25).map(|n| json!(100 * n)))));
}
