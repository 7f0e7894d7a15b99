//! Tests of `report/plot.rs`.

use std::time::Duration;

use super::*;

#[test]
fn what_is_no_finite_number_is_left_out_of_a_picture() {
    let huge = [1e200, 1e308, -1e308, f64::INFINITY, f64::NEG_INFINITY, f64::NAN];
    let estimate = |value: f64| Estimate { value, low: Some(-value), high: Some(value * value) };
    let points =
        |number: f64| [(number, estimate(1.0)), (1.0, estimate(number)), (2.0, estimate(3.0))];
    let line = |number: f64| Line { label: "a line".to_owned(), points: points(number).to_vec() };
    for is_power in [false, true] {
        let lines = huge.into_iter().map(line).collect();
        let references =
            huge.into_iter().map(|number| ("a reference".to_owned(), number)).collect();
        let picture = Picture {
            title: "a picture".to_owned(),
            is_power,
            references,
            lines,
            ..Picture::default()
        };
        let (tell, drawn) = std::sync::mpsc::channel();
        std::thread::spawn(move || tell.send(picture.svg().unwrap()));
        let svg = drawn.recv_timeout(Duration::from_secs(60)).expect("an axis has no end");
        assert!(
            svg.contains("a line") && svg.contains("a reference") && !svg.contains("NaN"),
            "{svg}"
        );
    }
}

#[test]
fn a_picture_that_cannot_be_written_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let taken = folder.path().join("picture.svg");
    std::fs::create_dir(&taken).unwrap();
    let error = Picture::default().write_svg(&taken).unwrap_err();
    assert!(error.to_string().contains("picture.svg"), "{error}");
    let there = std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path());
    assert_eq!(Vec::from_iter(there), [taken]);
}
