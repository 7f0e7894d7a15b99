//! Tests of `page/history.rs`.

use std::fs;

use serde_json::json;

use super::*;

/// A line for each of these hundreds of steps.
fn lines(numbers: impl IntoIterator<Item = u64>) -> String {
    let mut text = String::new();
    for n in numbers {
        let loss = 1.0 / n as f64;
        let line = json!({ "step": 100 * n, "seconds": 2 * n, "loss": loss, "eta": n % 2 });
        text += &format!("{line}\n");
    }
    text
}

/// The history of a file that is refreshed after each of these contents.
fn history(contents: &[String]) -> History {
    let folder = tempfile::tempdir().unwrap();
    let mut history = History::new(folder.path().join("metrics.jsonl"));
    let metrics = BTreeSet::from(["eta", "loss", "held_out_loss"].map(str::to_owned));
    history.refresh(&metrics).unwrap();
    for text in contents {
        fs::write(&history.path, text).unwrap();
        history.refresh(&metrics).unwrap();
    }
    history
}

#[test]
fn new_lines_are_read_when_they_are_complete_and_repeated_steps_replace_earlier_ones() {
    let (first, whole) = (lines(1..=3), lines(1..=4));
    let half = whole[..first.len() + 9].to_owned();
    let last = MAX_ROWS as u64 + 1;
    for (contents, expected) in [
        (vec![], vec![]),
        (vec![half.clone()], vec![1, 2, 3]),
        (vec![half, whole], vec![1, 2, 3, 4]),
        (vec![lines([1, 2, 2, 3])], vec![1, 2, 3]),
        // The file is shorter than before, or longer.
        (vec![lines(1..=20), lines((1..=5).chain(6..8))], Vec::from_iter(1..8)),
        (vec![lines(1..=20), lines((1..=5).chain(6..35))], Vec::from_iter(1..35)),
        // The last line starts a row of two.
        (vec![lines((1..=last).chain([last]))], Vec::from_iter((2..last).step_by(2).chain([last]))),
    ] {
        let history = history(&contents);
        let steps = history.rows.iter().map(|row| row.step as u64 / 100);
        assert_eq!(Vec::from_iter(steps), expected);
    }
}

#[test]
fn metrics_that_were_not_measured_are_null() {
    let lines = "{\"step\":1,\"seconds\":1.0,\"loss\":1.0}\n\
                 {\"step\":2,\"seconds\":2.0,\"loss\":2.0,\"held_out_loss\":8.0}\n\
                 {\"step\":3,\"seconds\":3.0,\"loss\":null,\"held_out_loss\":4.0}\n";
    let history = history(&[lines.to_owned()]);
    assert_eq!(history.names, ["loss", "held_out_loss"]);
    let expected = "[[1.0,1.0,1.0,null],[2.0,2.0,2.0,8.0],[3.0,3.0,null,4.0]]";
    assert_eq!(serde_json::to_string(&history.rows).unwrap(), expected);
    let [mut first, second, third] = <[Row; 3]>::try_from(history.rows).unwrap();
    first.merge(&second);
    first.merge(&third);
    assert_eq!(first.values, [(3.0, 2), (12.0, 2)]);
}

#[test]
fn long_runs_are_averaged() {
    let history = history(&[lines(1..=20_000)]);
    let rows = &history.rows;
    assert!((MAX_ROWS / 2..=MAX_ROWS).contains(&rows.len()));
    assert_eq!(rows.last().unwrap().step, 2_000_000.0);
    let lines = rows[0].step as u64 / 100;
    for row in &rows[..rows.len() - 1] {
        assert_eq!(row.values[0], (lines as f64 / 2.0, lines as u32));
    }
    let sum = (1..=lines).map(|n| 1.0 / n as f64).sum::<f64>();
    assert!((rows[0].values[1].0 - sum).abs() < 1e-9, "{:?}", rows[0]);
    assert!(serde_json::to_string(rows).unwrap().len() < 50_000);
}
