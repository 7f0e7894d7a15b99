use std::path::Path;

use quad_dataset::{Arrays, HoldOut, Names, RewardRule, Transitions, inspect, write_own};
use tempfile::tempdir;

use crate::{
    assert_error, assert_refused, batch, options, peers, peers_in, read, scratch, steps, try_read,
};

#[test]
fn the_ten_lines_of_the_page_write_what_is_read() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/data.md");
    let page = std::fs::read_to_string(page).unwrap();
    let (_, lines) = page.split_once("```python\n").unwrap();
    let (lines, _) = lines.split_once("```").unwrap();
    assert_eq!(lines.lines().count(), 10);
    let folder = tempdir().unwrap();
    std::fs::write(folder.path().join("lines.py"), lines).unwrap();
    let run = |arguments: &[&str]| peers_in(folder.path(), arguments);
    if !run(&["write-log", "log.npz"]) || !run(&["run", "lines.py"]) {
        return;
    }

    let transitions = read(&folder.path().join("my-robot.hdf5"), None, RewardRule::AsIs);
    let batch = batch(&transitions);
    assert_eq!(batch.steps.len(), 12);
    // `peers.py write-log` has the same formulas: s = 10 i + j, s' = s + 5, a = ±1/2, r = i.
    for i in 0..12 {
        let state = [0.0, 1.0, 2.0, 3.0, 4.0].map(|j| 10.0 * i as f32 + j);
        assert_eq!(batch.observations[5 * i..][..5], state);
        let next = &batch.next_observations[5 * i..][..5];
        assert_eq!(next, state.map(|x| x + 5.0));
        assert_eq!(batch.actions[2 * i..][..2], [0.5, -0.5]);
        assert_eq!(batch.rewards[i], i as f32);
        assert_eq!(batch.masks[i], if i == 3 { 0.0 } else { 1.0 });
    }
    // Episodes of 4 (terminal), 6 (timeout) and 2 (open) rows.
    let statistics = transitions.statistics();
    assert_eq!((statistics.episodes, statistics.score_mean), (3, None));
    assert_eq!([statistics.return_min, statistics.return_max], [6.0, 39.0]);
}

#[test]
fn the_layout_is_read_however_the_text_is_stored() {
    let layouts = "text bytes padded utf-8 variable-ascii one-element";
    for layout in layouts.split(' ') {
        let (_folder, path) = scratch("own.hdf5");
        if !peers(&["write-own", path.to_str().unwrap(), layout]) {
            return;
        }
        // D4RL's rules would give 8: the last row makes no transition.
        let transitions = try_read(&path, None).unwrap();
        assert_eq!(transitions.len(), 9, "{layout}");
        // Without timeouts, a row that starts elsewhere begins an episode.
        assert_eq!(transitions.statistics().episodes, 3);
    }
}

#[test]
fn layouts_and_actions_that_are_refused() {
    let layout = "but may only be \"transitions\"";
    let unknown = format!("the attribute `layout` is \"transition\", {layout}");
    let number = format!("the attribute `layout` is \"\", {layout}");
    let discrete =
        "array `actions` holds whole numbers, but only continuous actions can be learned";
    for (arguments, message, hint) in [
        (&["unknown"][..], &*unknown, "docs/data.md"),
        (&["number"], &number, "docs/data.md"),
        (&["text", "int64"], discrete, "float32"),
        (&["text", "uint8"], discrete, "float32"),
    ] {
        let (_folder, path) = scratch("own.hdf5");
        if peers(&[&["write-own", path.to_str().unwrap()], arguments].concat()) {
            assert_refused(&path, None, message, hint);
        }
    }
}

fn arrays() -> Arrays {
    let numbers = |count: usize, from: f32| (0..count).map(|i| from + 0.5 * i as f32).collect();
    Arrays {
        observation_dim: 3,
        action_dim: 2,
        observations: numbers(18, 1e6),
        actions: numbers(12, 24.5),
        rewards: numbers(6, -1.0),
        next_observations: numbers(18, 1e6 + 1.5),
        terminals: vec![false, false, true, false, false, false],
        timeouts: vec![false, false, false, false, false, true],
    }
}

/// With actions within [-1, 1].
fn small() -> Arrays {
    let mut arrays = arrays();
    arrays.actions.fill(0.25);
    arrays
}

fn names(observations: &[&str], actions: &[&str]) -> Names {
    let [observations, actions] =
        [observations, actions].map(|names| names.iter().map(|name| name.to_string()).collect());
    Names { observations, actions }
}

#[test]
fn arrays_are_written_and_read_again() {
    let (_folder, path) = scratch("new/own.hdf5");
    let names = names(&["x", "y", "θ"], &["left", "right"]);
    write_own(&path, small(), Names::default()).unwrap();
    write_own(&path, arrays(), names.clone()).unwrap();
    let files = std::fs::read_dir(path.parent().unwrap()).unwrap();
    let files = Vec::from_iter(files.map(|file| file.unwrap().path()));
    assert_eq!(files, [&*path], "nothing partial, and one replaced");

    let inspection = inspect(&[&path], None).unwrap();
    let problem = &inspection.problems[0];
    assert_eq!((&*inspection.format, inspection.episodes), ("transitions", 2));
    assert!(!inspection.refused && problem.contains("--normalize actions"));
    let message = "the action 24.5 is outside [-1, 1] (6 such rows)";
    assert_refused(&path, None, message, "--normalize actions");

    write_own(&path, small(), names.clone()).unwrap();
    let from_file = try_read(&path, None).unwrap();
    let from_arrays = Transitions::of(small()).unwrap();
    assert_eq!(batch(&from_file), batch(&from_arrays));
    assert_eq!(from_file.statistics(), from_arrays.statistics());
    assert_eq!(*from_file.names(), names);
    write_own(&path, small(), self::names(&["x", "y"], &[])).unwrap();
    let message = "the attribute `observation_names` has 2 texts for 3 numbers";
    assert_refused(&path, None, message, "docs/data.md");
}

#[test]
fn names_that_place_no_number_are_refused() {
    let (folder, path) = scratch("own.hdf5");
    let hint = "one of its own, such as left_gripper and right_gripper";
    for (texts, name) in [
        (["x", "g", "g"], "\"g\" for columns 1, 2"),
        (["x", " ", "z"], "\" \" for column 1"),
        (["x", "y", "a\nb"], "\"a\\nb\" for column 2"),
    ] {
        let error = write_own(&path, small(), names(&texts, &[])).unwrap_err();
        let message = format!("the attribute `observation_names` has the name {name}");
        assert_error(&error, &message, hint);
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    // One name may be of an observation and of an action.
    write_own(&path, small(), names(&["y", "x", "z"], &["x", "y"])).unwrap();
    try_read(&path, None).unwrap();
    // A program that does not check names.
    overwrite(&path, b"x\0", b"y\0");
    assert_refused(&path, None, "has the name \"y\" for columns 0, 1", hint);
    assert!(inspect(&[&path], None).unwrap().refused);
}

/// Replaces the last bytes of a file that are `old`.
fn overwrite(path: &Path, old: &[u8], new: &[u8]) {
    let mut bytes = std::fs::read(path).unwrap();
    let mut windows = bytes.windows(old.len());
    let place = windows.rposition(|bytes| bytes == old).unwrap();
    bytes[place..][..new.len()].copy_from_slice(new);
    std::fs::write(path, bytes).unwrap();
}

#[test]
fn names_in_latin_1_become_utf_8() {
    let (_folder, path) = scratch("own.hdf5");
    write_own(&path, small(), names(&["x", "y", "in grad#"], &[])).unwrap();
    overwrite(&path, b"in grad#", b"in grad\xb0"); // The degree sign.
    let transitions = try_read(&path, None).unwrap();
    assert_eq!(transitions.names().observations[2], "in grad\u{fffd}");
}

#[test]
fn arrays_that_would_be_refused_are_not_written() {
    let (folder, path) = scratch("own.hdf5");
    let spoil = |change: fn(&mut Arrays), message: &str| {
        let mut arrays = arrays();
        change(&mut arrays);
        let error = write_own(&path, arrays, Names::default()).unwrap_err();
        assert_error(&error, message, "");
    };
    let message = "array `observations`, row 1: NaN is not a finite float32";
    spoil(|arrays| arrays.observations[4] = f32::NAN, message);
    let message = "array `actions` has shape [11], but must have [6, 2]";
    spoil(|arrays| arrays.actions.truncate(11), message);
    let message = "6 rows without a terminal or timeout: one endless episode";
    let endless: fn(&mut Arrays) = |arrays| {
        arrays.terminals.fill(false);
        arrays.timeouts.fill(false);
    };
    spoil(endless, message);
    let message = "must have rows, or rows of numbers";
    spoil(|arrays| arrays.action_dim = 0, message);
    let error = write_own(&path, steps(0, 3, 2), Names::default()).unwrap_err();
    assert_error(&error, "0 rows, of which none makes a transition", "");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn episodes_that_are_held_out_keep_their_next_observations() {
    let (_folder, path) = scratch("own.hdf5");
    write_own(&path, small(), Names::default()).unwrap();
    let (options, next) = (options(None, RewardRule::AsIs), arrays().next_observations);
    let split = |out: &[usize]| Transitions::read_split(&[&path], &options, HoldOut::Episodes(out));
    let split_off = split(&[0]).unwrap();
    let held_out = split_off.held_out.unwrap();
    assert_eq!(batch(&held_out).next_observations, next[..9]);
    assert_eq!(batch(&split_off.training).next_observations, next[9..]);
    let error = split(&[0, 1]).err().unwrap();
    let message = "0 rows, of which none makes a transition";
    assert_error(&error, message, "record more");
}
