use std::path::Path;

use quad_dataset::{
    Arrays, HoldOut, Inspection, Names, RewardRule, Transitions, inspect, write_own,
};
use tempfile::tempdir;

use crate::{all, assert_error, assert_refused, options, peers, peers_in, read, scratch, try_read};

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
    let run = |arguments: &[&str]| peers_in(folder.path(), arguments);
    if !run(&["write-log", "log.npz"]) || !run(&["run", "lines.py"]) {
        return;
    }

    let transitions = read(&folder.path().join("my-robot.hdf5"), None, RewardRule::AsIs);
    let batch = all(&transitions);
    let sizes = (batch.rewards.len(), transitions.observation_dim(), transitions.action_dim());
    assert_eq!(sizes, (12, 5, 2));
    // `peers.py write-log` has the same formulas: s = 10 i + j, s' = s + 5, a = ±1/2, r = i.
    for i in 0..12 {
        let state = [0.0, 1.0, 2.0, 3.0, 4.0].map(|j| 10.0 * i as f32 + j);
        assert_eq!(batch.observations[5 * i..][..5], state);
        assert_eq!(batch.next_observations[5 * i..][..5], state.map(|x| x + 5.0));
        assert_eq!(batch.actions[2 * i..][..2], [0.5, -0.5]);
        assert_eq!(batch.rewards[i], i as f32);
        assert_eq!(batch.masks[i], if i == 3 { 0.0 } else { 1.0 });
    }
    // Episodes of 4 (terminal), 6 (timeout) and 2 (open) rows.
    let found = transitions.statistics();
    let returns = (found.return_min, found.return_max);
    assert_eq!((found.episodes, returns, found.score_mean), (3, (6.0, 39.0), None));
}

#[test]
fn the_layout_is_read_however_the_text_is_stored() {
    for layout in ["text", "bytes", "padded", "utf-8", "variable-ascii", "one-element"] {
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

#[test]
fn arrays_are_written_and_read_again() {
    let (_folder, path) = scratch("new/own.hdf5");
    let names = ["x", "y", "θ", "left", "right"].map(str::to_owned);
    let names = Names { observations: names[..3].to_vec(), actions: names[3..].to_vec() };
    write_own(&path, Arrays { rewards: vec![0.0; 6], ..arrays() }, Names::default()).unwrap();
    write_own(&path, arrays(), names.clone()).unwrap();
    let files = std::fs::read_dir(path.parent().unwrap()).unwrap();
    let files = Vec::from_iter(files.map(|file| file.unwrap().path()));
    assert_eq!(files, [&*path], "nothing partial is left, and what was there is replaced");

    let found = inspect(&path, None).unwrap();
    let sizes = (found.transitions, found.episodes);
    assert_eq!((found.format, sizes, found.refused), ("transitions", (6, 2), false));
    assert_eq!(found.action_range.max, 30.0);
    let problems = found.problems;
    assert!(problems[0].contains("--normalize actions"), "{problems:?}");
    let message = "the action 24.5 is outside [-1, 1] (6 such rows)";
    assert_refused(&path, None, message, "--normalize actions");

    let small = Arrays { actions: vec![0.25; 12], ..arrays() };
    write_own(&path, small.clone(), names.clone()).unwrap();
    let from_file = try_read(&path, None).unwrap();
    let from_arrays = Transitions::of(small.clone()).unwrap();
    assert_eq!(all(&from_file), all(&from_arrays));
    assert_eq!(from_file.statistics(), from_arrays.statistics());
    assert_eq!((from_file.names(), from_arrays.names()), (&names, &Names::default()));
    let few = Names { actions: Vec::new(), observations: names.observations[1..].to_vec() };
    write_own(&path, small, few).unwrap();
    let message = "the attribute `observation_names` has 2 texts for 3 numbers";
    assert_refused(&path, None, message, "docs/data.md");
}

#[test]
fn names_that_place_no_number_are_refused() {
    let (folder, path) = scratch("own.hdf5");
    let small = Arrays { actions: vec![0.25; 12], ..arrays() };
    for (names, message) in [
        (["x", "g", "g"], "the attribute `observation_names` has the name \"g\" for columns 1, 2"),
        (["x", " ", "z"], "the attribute `observation_names` has the name \" \" for column 1"),
        (
            ["x", "y", "a\nb"],
            "the attribute `observation_names` has the name \"a\\nb\" for column 2",
        ),
    ] {
        let observations = names.map(str::to_owned).to_vec();
        let names = Names { observations, actions: Vec::new() };
        let error = write_own(&path, small.clone(), names).unwrap_err();
        assert_error(&error, message, "one of its own, such as left_gripper and right_gripper");
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    // One name may be of an observation and of an action.
    let names = |name: &str| vec!["x".to_owned(), name.to_owned()];
    let own = Names {
        observations: [names("y"), names("z")].concat()[1..].to_vec(),
        actions: names("y"),
    };
    write_own(&path, small, own).unwrap();
    try_read(&path, None).unwrap();
    // Of a program that does not check them.
    let mut bytes = std::fs::read(&path).unwrap();
    let place = bytes.windows(2).rposition(|bytes| bytes == b"x\0").unwrap();
    bytes[place] = b'y';
    std::fs::write(&path, bytes).unwrap();
    let message = "has the name \"y\" for columns 0, 1";
    assert_refused(&path, None, message, "one of its own");
    let Inspection { refused, problems, .. } = inspect(&path, None).unwrap();
    assert!(refused && problems[0].contains(message), "{problems:?}");
}

#[test]
fn names_in_latin_1_become_utf_8() {
    let (_folder, path) = scratch("own.hdf5");
    let observations = ["x", "y", "in grad#"].map(str::to_owned).to_vec();
    let names = Names { observations, actions: Vec::new() };
    write_own(&path, Arrays { actions: vec![0.25; 12], ..arrays() }, names).unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    let place = bytes.windows(8).position(|bytes| bytes == b"in grad#").unwrap();
    bytes[place + 7] = 0xb0; // The degree sign.
    std::fs::write(&path, bytes).unwrap();
    let transitions = try_read(&path, None).unwrap();
    assert_eq!(transitions.names().observations[2], "in grad\u{fffd}");
}

#[test]
fn arrays_that_would_be_refused_are_not_written() {
    let (folder, path) = scratch("own.hdf5");
    type Spoil = fn(&mut Arrays);
    let cases: [(&str, Spoil); 5] = [
        ("array `observations`, row 1: NaN is not a finite float32", |arrays| {
            arrays.observations[4] = f32::NAN
        }),
        ("array `actions` has shape [11], but must have [6, 2]", |arrays| {
            arrays.actions.truncate(11)
        }),
        ("6 rows without a terminal or timeout: one endless episode", |arrays| {
            (arrays.terminals[2], arrays.timeouts[5]) = (false, false)
        }),
        ("0 rows, of which none makes a transition", |arrays| {
            *arrays = Arrays { observation_dim: 3, action_dim: 2, ..Arrays::default() }
        }),
        ("must have rows, or rows of numbers", |arrays| {
            (arrays.action_dim, arrays.actions) = (0, Vec::new())
        }),
    ];
    for (message, spoil) in cases {
        let mut arrays = arrays();
        spoil(&mut arrays);
        assert_error(&write_own(&path, arrays, Names::default()).unwrap_err(), message, "");
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn episodes_that_are_held_out_keep_their_next_observations() {
    let (_folder, path) = scratch("own.hdf5");
    write_own(&path, Arrays { actions: vec![0.25; 12], ..arrays() }, Names::default()).unwrap();
    let (options, next) = (options(None, RewardRule::AsIs), arrays().next_observations);
    let split = Transitions::read_split(&path, &options, HoldOut::Episodes(&[0])).unwrap();
    assert_eq!(all(&split.held_out.unwrap()).next_observations, next[..9]);
    assert_eq!(all(&split.training).next_observations, next[9..]);
    let all_out = Transitions::read_split(&path, &options, HoldOut::Episodes(&[0, 1]));
    let message = "0 rows, of which none makes a transition";
    assert_error(&all_out.err().unwrap(), message, "record more");
}
