//! Tests of `report/plot.rs`.

use std::fs;
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use super::*;

#[test]
fn infinite_values_are_not_drawn() {
    let huge = [1e200, 1e308, -1e308, f64::INFINITY, f64::NEG_INFINITY, f64::NAN];
    let estimate = |value: f64| Estimate { value, low: Some(-value), high: Some(value * value) };
    let line = |huge: f64| {
        let points = vec![(huge, estimate(1.0)), (1.0, estimate(huge)), (2.0, estimate(3.0))];
        Line { label: "a line".to_owned(), points }
    };
    for is_log in [false, true] {
        let plot = Plot {
            is_log,
            references: huge.map(|huge| ("a reference".to_owned(), huge)).to_vec(),
            lines: huge.map(line).to_vec(),
            ..Plot::default()
        };
        let (tx, rx) = mpsc::channel();
        thread::spawn(move || tx.send(plot.svg().unwrap()));
        let svg = rx.recv_timeout(Duration::from_secs(60)).expect("an axis has no end");
        assert!(svg.contains("a line") && svg.contains("a reference"), "{svg}");
        assert!(!svg.contains("NaN"), "{svg}");
    }
}

#[test]
fn a_failed_write_leaves_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let taken = folder.path().join("plot.svg");
    fs::create_dir(&taken).unwrap();
    let error = Plot::default().write_svg(&taken).unwrap_err();
    assert!(error.to_string().contains("plot.svg"), "{error}");
    let files = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path());
    assert_eq!(Vec::from_iter(files), [taken]);
}
