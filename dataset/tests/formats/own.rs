//! People's own data, as docs/data.md tells them to write it.

use std::path::Path;

use quad_dataset::{DatasetError, ReadOptions, RewardRule, Transitions};
use tempfile::tempdir;

use crate::{all, peers, peers_in, read};

/// The Python of docs/data.md that writes a file.
fn lines_of_the_page() -> String {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/data.md");
    let page = std::fs::read_to_string(page).unwrap();
    let (_, rest) = page.split_once("```python\n").unwrap();
    rest.split_once("```").unwrap().0.to_owned()
}

#[test]
fn the_ten_lines_of_the_page_write_what_is_read() {
    let lines = lines_of_the_page();
    assert_eq!(lines.lines().count(), 10);
    let folder = tempdir().unwrap();
    std::fs::write(folder.path().join("lines.py"), lines).unwrap();
    if !peers_in(folder.path(), &["write-log", "log.npz"]) || !peers_in(folder.path(), &["run", "lines.py"]) {
        return;
    }

    let transitions = read(&folder.path().join("my-robot.hdf5"), None, RewardRule::AsIs);
    assert_eq!((transitions.len(), transitions.observation_dim(), transitions.action_dim()), (12, 5, 2));
    let batch = all(&transitions);
    // `peers.py write-log` has the same formulas: s = 10 i + j, s' = s + 5, a = ±1/2, r = i.
    let numbers = |first: f32| (0..12).flat_map(move |i| (0..5).map(move |j| (10 * i + j) as f32 + first));
    assert_eq!(batch.observations, numbers(0.0).collect::<Vec<_>>());
    assert_eq!(batch.next_observations, numbers(5.0).collect::<Vec<_>>());
    assert_eq!(batch.actions, [0.5, -0.5].repeat(12));
    assert_eq!(batch.rewards, (0..12).map(|i| i as f32).collect::<Vec<_>>());
    // Episodes of 4 (terminal), 6 (timeout) and 2 (open) rows.
    assert_eq!(batch.masks, (0..12).map(|i| if i == 3 { 0.0 } else { 1.0 }).collect::<Vec<_>>());
    let statistics = transitions.statistics();
    let figures = (statistics.episodes, statistics.return_min, statistics.return_max, statistics.score_mean);
    assert_eq!(figures, (3, 6.0, 39.0, None));
}

/// Writes a small file with `peers.py write-own` and reads it; `None` where there is no Python.
fn read_own(arguments: &[&str]) -> Option<Result<Transitions, DatasetError>> {
    let folder = tempdir().unwrap();
    let path = folder.path().join("own.hdf5");
    let arguments = [&["write-own", path.to_str().unwrap()], arguments].concat();
    let options = ReadOptions { environment: None, reward: RewardRule::AsIs };
    peers(&arguments).then(|| Transitions::read(&path, &options))
}

#[test]
fn without_timeouts_a_row_that_starts_elsewhere_begins_an_episode() {
    let Some(transitions) = read_own(&[]) else { return };
    let transitions = transitions.unwrap();
    assert_eq!((transitions.len(), transitions.statistics().episodes), (9, 3));
}

#[test]
fn the_layout_is_read_however_the_text_is_stored() {
    for layout in ["text", "bytes", "padded", "utf-8", "variable-ascii", "one-element"] {
        let Some(transitions) = read_own(&[layout]) else { return };
        // By D4RL's rules there would be 8 and not 9: the last row makes no transition.
        assert_eq!(transitions.map(|transitions| transitions.len()).ok(), Some(9), "{layout}");
    }
}

#[test]
fn a_layout_without_a_meaning() {
    for (layout, found) in [("unknown", "\"transition\""), ("number", "\"\"")] {
        let Some(result) = read_own(&[layout]) else { return };
        let error = result.err().unwrap().to_string();
        let expected =
            format!("the attribute `layout` is {found}, but the only value with a meaning is \"transitions\"");
        assert!(error.ends_with(&expected), "{error}");
    }
}

#[test]
fn discrete_actions() {
    for kind in ["int64", "uint8"] {
        let Some(result) = read_own(&["text", kind]) else { return };
        let error = result.err().unwrap();
        let expected =
            "array `actions` holds whole numbers, as if actions were discrete; only continuous ones can be learnt";
        assert!(error.to_string().ends_with(expected), "{error}");
        assert!(error.hint().contains("float32"), "{}", error.hint());
    }
}
