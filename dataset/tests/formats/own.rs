use std::path::Path;

use quad_dataset::{
    Arrays, DatasetError, HoldOut, Names, RewardRule, Transitions, inspect, write_own,
};
use tempfile::tempdir;

use crate::{all, options, peers, peers_in, read, try_read};

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
    if !peers_in(folder.path(), &["write-log", "log.npz"])
        || !peers_in(folder.path(), &["run", "lines.py"])
    {
        return;
    }

    let transitions = read(&folder.path().join("my-robot.hdf5"), None, RewardRule::AsIs);
    assert_eq!(
        (transitions.len(), transitions.observation_dim(), transitions.action_dim()),
        (12, 5, 2)
    );
    let batch = all(&transitions);
    // `peers.py write-log` has the same formulas: s = 10 i + j, s' = s + 5, a = ±1/2, r = i.
    let numbers =
        |first: f32| (0..12).flat_map(move |i| (0..5).map(move |j| (10 * i + j) as f32 + first));
    assert_eq!(batch.observations, numbers(0.0).collect::<Vec<_>>());
    assert_eq!(batch.next_observations, numbers(5.0).collect::<Vec<_>>());
    assert_eq!(batch.actions, [0.5, -0.5].repeat(12));
    assert_eq!(batch.rewards, (0..12).map(|i| i as f32).collect::<Vec<_>>());
    // Episodes of 4 (terminal), 6 (timeout) and 2 (open) rows.
    assert_eq!(batch.masks, (0..12).map(|i| if i == 3 { 0.0 } else { 1.0 }).collect::<Vec<_>>());
    let statistics = transitions.statistics();
    let figures =
        (statistics.episodes, statistics.return_min, statistics.return_max, statistics.score_mean);
    assert_eq!(figures, (3, 6.0, 39.0, None));
}

fn read_own(arguments: &[&str]) -> Option<Result<Transitions, DatasetError>> {
    let folder = tempdir().unwrap();
    let path = folder.path().join("own.hdf5");
    let arguments = [&["write-own", path.to_str().unwrap()], arguments].concat();
    peers(&arguments).then(|| try_read(&path, None))
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
        // D4RL's rules would give 8: the last row makes no transition.
        assert_eq!(transitions.map(|transitions| transitions.len()).ok(), Some(9), "{layout}");
    }
}

#[test]
fn a_layout_without_a_meaning() {
    for (layout, found) in [("unknown", "\"transition\""), ("number", "\"\"")] {
        let Some(result) = read_own(&[layout]) else { return };
        let error = result.err().unwrap().to_string();
        let expected = format!(
            "the attribute `layout` is {found}, but the only value with a meaning is \"transitions\""
        );
        assert!(error.ends_with(&expected), "{error}");
    }
}

#[test]
fn discrete_actions() {
    for kind in ["int64", "uint8"] {
        let Some(result) = read_own(&["text", kind]) else { return };
        let error = result.err().unwrap();
        let expected = "array `actions` holds whole numbers, as if actions were discrete; only continuous ones can be learned";
        assert!(error.to_string().ends_with(expected), "{error}");
        assert!(error.hint().contains("float32"), "{}", error.hint());
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
    let folder = tempdir().unwrap();
    let path = folder.path().join("new/own.hdf5");
    let names = ["x", "y", "θ", "left", "right"].map(str::to_owned);
    let names = Names { observations: names[..3].to_vec(), actions: names[3..].to_vec() };
    write_own(&path, Arrays { rewards: vec![0.0; 6], ..arrays() }, Names::default()).unwrap();
    write_own(&path, arrays(), names.clone()).unwrap();
    let files: Vec<_> = std::fs::read_dir(path.parent().unwrap())
        .unwrap()
        .map(|file| file.unwrap().path())
        .collect();
    assert_eq!(
        files,
        std::slice::from_ref(&path),
        "nothing partial is left, and what was there is replaced"
    );

    let inspection = inspect(&path, None).unwrap();
    assert_eq!(
        (inspection.format, inspection.transitions, inspection.episodes),
        ("transitions", 6, 2)
    );
    assert_eq!(inspection.action_range.max, 30.0);
    assert!(
        !inspection.refused && inspection.problems[0].contains("--normalize actions"),
        "{:?}",
        inspection.problems
    );
    let error = try_read(&path, None).err().unwrap();
    assert!(
        error.to_string().ends_with("the action 24.5 is outside [-1, 1] (6 such rows)"),
        "{error}"
    );
    assert!(error.hint().contains("--normalize actions"), "{}", error.hint());

    let small = Arrays { actions: vec![0.25; 12], ..arrays() };
    write_own(&path, small.clone(), names.clone()).unwrap();
    let (from_file, from_arrays) =
        (try_read(&path, None).unwrap(), Transitions::of(small.clone()).unwrap());
    assert_eq!(all(&from_file), all(&from_arrays));
    assert_eq!(from_file.statistics(), from_arrays.statistics());
    assert_eq!((from_file.names(), from_arrays.names()), (&names, &Names::default()));
    let few = Names { actions: Vec::new(), observations: names.observations[1..].to_vec() };
    write_own(&path, small, few).unwrap();
    let error = try_read(&path, None).err().unwrap();
    assert!(
        error
            .to_string()
            .ends_with("the attribute `observation_names` has 2 texts, but a row has 3 numbers")
    );
}

#[test]
fn arrays_that_would_be_refused_are_not_written() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("own.hdf5");
    let refused = |arrays: Arrays| {
        write_own(&path, arrays, Names::default()).unwrap_err().problem.to_string()
    };
    let broken = |spoil: fn(&mut Arrays)| {
        let mut arrays = arrays();
        spoil(&mut arrays);
        refused(arrays)
    };
    let unknown = broken(|arrays| arrays.observations[4] = f32::NAN);
    assert_eq!(unknown, "array `observations`, row 1: NaN is not a finite float32");
    let short = broken(|arrays| arrays.actions.truncate(11));
    assert_eq!(short, "array `actions` has 11 numbers, but 6 rows of 2 are 12");
    let endless = broken(|arrays| {
        [&mut arrays.terminals, &mut arrays.timeouts].into_iter().for_each(|f| f.fill(false))
    });
    assert!(endless.contains("one endless episode"));
    let none = Arrays { observation_dim: 3, action_dim: 2, ..Arrays::default() };
    assert_eq!(refused(none), "0 rows, of which none makes a transition");
    let without_actions = Arrays { action_dim: 0, actions: Vec::new(), ..arrays() };
    assert!(refused(without_actions).starts_with("array `actions` has shape [6, 0]"));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn rows_in_any_order_are_learned_from_with_the_next_observations_of_their_own() {
    let strange = Arrays { next_observations: vec![7.0; 18], actions: vec![0.25; 12], ..arrays() };
    assert_eq!(all(&Transitions::of(strange).unwrap()).next_observations, [7.0; 18]);
}

#[test]
fn episodes_that_are_held_out_keep_their_next_observations() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("own.hdf5");
    write_own(&path, Arrays { actions: vec![0.25; 12], ..arrays() }, Names::default()).unwrap();
    let split =
        Transitions::read_split(&path, &options(None, RewardRule::AsIs), HoldOut::Episodes(&[0]))
            .unwrap();
    let next = arrays().next_observations;
    assert_eq!(all(&split.held_out.unwrap()).next_observations, next[..9]);
    assert_eq!(all(&split.training).next_observations, next[9..]);
}
