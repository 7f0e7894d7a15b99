//! Tests of `page/reader.rs`.

use std::fs;

use super::*;
use crate::fixtures::config;

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
            metrics +=
                &format!("{{\"step\":{step},\"seconds\":{step}.0,\"bc_loss\":{started}.0}}\n");
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
fn names_that_no_metric_has_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("run");
    RunDir::create(&dir, &config("run", 0)).unwrap();
    let mut metrics = String::new();
    for step in 1..=40_000 {
        metrics += &format!("{{\"step\":{step},\"name{step}\":1.0,\"held_out_bc_loss\":2.0}}\n");
    }
    fs::write(dir.join("metrics.jsonl"), metrics).unwrap();
    let shown = RunPage::of(&dir).read().unwrap();
    assert_eq!(shown["history"]["names"], json!(["held_out_bc_loss"]));
}
