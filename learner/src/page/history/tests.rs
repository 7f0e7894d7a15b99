//! Tests of `page/history.rs`.

use std::fs;
use std::io::Write;

use serde_json::{Value, json};

use super::*;

/// A line of each of these hundreds of steps.
fn lines(numbers: impl IntoIterator<Item = u64>) -> String {
    let line = |n| {
        json!({ "step": 100 * n, "seconds": 2 * n, "loss": 1.0 / n as f64, "eta": n % 2 })
            .to_string()
            + "\n"
    };
    numbers.into_iter().map(line).collect()
}

fn shown(history: &History) -> Value {
    serde_json::to_value(history).unwrap()
}

#[test]
fn new_lines_are_added_and_half_a_line_waits() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("metrics.jsonl");
    let mut history = History::of(path.clone());
    history.refresh().unwrap();
    assert_eq!(shown(&history)["rows"], json!([]));
    let (first, second) = (lines(1..=3), lines([4]));
    fs::write(&path, first + &second[..9]).unwrap();
    history.refresh().unwrap();
    let expected =
        json!([[100.0, 2.0, 1.0, 1.0], [200.0, 4.0, 0.0, 0.5], [300.0, 6.0, 1.0, 0.33333]]);
    assert_eq!(
        (&shown(&history)["names"], &shown(&history)["rows"]),
        (&json!(["eta", "loss"]), &expected)
    );
    let mut file = fs::OpenOptions::new().append(true).open(&path).unwrap();
    file.write_all(&second.as_bytes()[9..]).unwrap();
    history.refresh().unwrap();
    assert_eq!(shown(&history)["rows"][3], json!([400.0, 8.0, 0.0, 0.25]));
}

/// Whether the file is shorter then, or has grown beyond where it was.
#[test]
fn a_run_that_went_back_to_its_checkpoint_is_shown_as_it_went_on() {
    for longer in [3, 30] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        let mut history = History::of(path.clone());
        fs::write(&path, lines(1..=20)).unwrap();
        history.refresh().unwrap();
        fs::write(&path, lines((1..=5).chain(6..5 + longer))).unwrap();
        history.refresh().unwrap();
        let steps: Vec<u64> = history.rows.iter().map(|row| row.step as u64).collect();
        assert_eq!(steps, Vec::from_iter((1..5 + longer).map(|n| 100 * n)));
    }
}

/// As of held-out episodes, which are measured now and then, or where the number was not finite.
#[test]
fn what_was_not_measured_at_a_step_leaves_its_other_numbers_and_other_steps_alone() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("metrics.jsonl");
    let lines = [
        "\"loss\":1.0",
        "\"loss\":2.0,\"held_out_loss\":8.0",
        "\"loss\":null,\"held_out_loss\":4.0",
    ];
    let lines = (1..)
        .zip(lines)
        .map(|(step, rest)| format!("{{\"step\":{step},\"seconds\":{step}.0,{rest}}}\n"));
    fs::write(&path, lines.collect::<String>()).unwrap();
    let mut history = History::of(path);
    history.refresh().unwrap();
    let expected = json!([[1.0, 1.0, 1.0, null], [2.0, 2.0, 2.0, 8.0], [3.0, 3.0, null, 4.0]]);
    assert_eq!(
        (&shown(&history)["names"], &shown(&history)["rows"]),
        (&json!(["loss", "held_out_loss"]), &expected)
    );
    let mut rows = history.rows.into_iter();
    let mut first = rows.next().unwrap();
    rows.for_each(|row| first.join(&row));
    assert_eq!(first.values, [(3.0, 2), (12.0, 2)], "sums of what there is, and of how many lines");
}

#[test]
fn a_file_that_has_a_step_twice_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("metrics.jsonl");
    fs::write(&path, lines([1, 2, 2, 3])).unwrap();
    let mut history = History::of(path);
    history.refresh().unwrap();
    assert_eq!(history.rows.iter().map(|row| row.step).collect::<Vec<_>>(), [100.0, 200.0, 300.0]);
}

#[test]
fn a_long_run_is_thinned_and_not_cut() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("metrics.jsonl");
    fs::write(&path, lines(1..=20_000)).unwrap();
    let mut history = History::of(path);
    history.refresh().unwrap();
    let rows = &history.rows;
    assert!((MOST_ROWS / 2..=MOST_ROWS).contains(&rows.len()), "{}", rows.len());
    assert_eq!(rows.last().unwrap().step, 2_000_000.0);
    // Means: each line counts once, and η is 0 and 1 in turn.
    let whole = &rows[..rows.len() - 1];
    let mean = |row: &Row, metric: usize| row.values[metric].0 / f64::from(row.values[metric].1);
    assert!(whole.iter().all(|row| (mean(row, 0) - 0.5).abs() < 1e-9), "{:?}", rows.first());
    let (first, mean) = (rows[0].step as u64 / 100, mean(&rows[0], 1));
    let expected = (1..=first).map(|n| 1.0 / n as f64).sum::<f64>() / first as f64;
    assert!((mean - expected).abs() < 1e-9, "{mean} is not {expected}, of {first} lines");
    assert!(shown(&history).to_string().len() < 50_000);
}

/// Phases measure different metrics; a mean is of the lines that have it.
#[test]
fn what_a_line_does_not_have_is_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("metrics.jsonl");
    let line = |n: u64| match n {
        ..=700 => json!({ "step": n, "seconds": 1, "first": 1 }),
        701..=1400 => json!({ "step": n, "seconds": 1, "second": 2, "both": n % 2 }),
        _ => json!({ "step": n, "seconds": 1, "third": 3, "second": 4 }),
    };
    let mut history = History::of(path.clone());
    fs::write(&path, Vec::from_iter((1..=2).map(|n| line(n).to_string() + "\n")).concat()).unwrap();
    history.refresh().unwrap();
    assert_eq!(
        (&shown(&history)["names"], &shown(&history)["rows"][1]),
        (&json!(["first"]), &json!([2.0, 1.0, 1.0]))
    );
    fs::write(&path, Vec::from_iter((1..=2100).map(|n| line(n).to_string() + "\n")).concat())
        .unwrap();
    history.refresh().unwrap();
    let shown = shown(&history);
    assert_eq!(shown["names"], json!(["first", "both", "second", "third"]));
    let rows = shown["rows"].as_array().unwrap();
    assert!(rows.len() < 600 && rows.iter().all(|row| row.as_array().unwrap().len() == 6));
    let values = |row: &Value| [2, 3, 4, 5].map(|column| row[column].as_f64());
    assert_eq!(values(&rows[0]), [Some(1.0), None, None, None]);
    assert_eq!(values(&rows[rows.len() / 2]), [None, Some(0.5), Some(2.0), None]);
    assert_eq!(values(rows.last().unwrap()), [None, None, Some(4.0), Some(3.0)]);
    // A row across both phases: no zeros are mixed in.
    assert!(rows.iter().all(|row| values(row)[0].is_none_or(|first| first == 1.0)), "{rows:?}");
}

#[test]
fn numbers_have_five_digits() {
    let numbers =
        [0.0, 1.0, -2.345_678_9, 12_345_678.9, 1.234_567_8e-20, 3.0e-320, f64::NAN, f64::INFINITY];
    let expected = [Some(0.0), Some(1.0), Some(-2.3457), Some(12_346_000.0), Some(1.2346e-20)];
    assert_eq!(numbers[..5].iter().map(|number| rounded(*number)).collect::<Vec<_>>(), expected);
    assert!(rounded(numbers[5]).is_some_and(|tiny| tiny < 1e-300));
    assert_eq!((rounded(numbers[6]), rounded(numbers[7])), (None, None));
}

#[test]
fn steps_that_are_done_again_join_no_row_that_was_whole() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("metrics.jsonl");
    // The last line begins a row of two.
    let last = MOST_ROWS as u64 + 1;
    fs::write(&path, lines((1..=last).chain([last]))).unwrap();
    let mut history = History::of(path);
    history.refresh().unwrap();
    let [.., before, again] = &history.rows[..] else { panic!("{history:?}") };
    assert_eq!((before.step, again.step), (100.0 * (last - 1) as f64, 100.0 * last as f64));
}
