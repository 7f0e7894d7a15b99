//! Tests of `report/plot.rs`.

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
        let mut plot = Plot { is_log, ..Plot::default() };
        plot.references.extend(huge.map(|huge| ("a reference".to_owned(), huge)));
        plot.lines.extend(huge.map(line));
        let (tx, rx) = mpsc::channel();
        thread::spawn(move || tx.send(plot.svg().unwrap()));
        let svg = rx.recv_timeout(Duration::from_secs(60)).expect("an axis has no end");
        assert!(svg.contains("a line") && svg.contains("a reference"), "{svg}");
        assert!(!svg.contains("NaN"), "{svg}");
    }
}
