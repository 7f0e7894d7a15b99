//! Several files that are one dataset.

use std::ops::Range;
use std::path::Path;

use hdf5::types::VarLenUnicode;
use quad_dataset::{
    Arrays, Batch, DatasetError, HoldOut, Names, ReadOptions, Split, Transitions, Window, inspect,
    write_own,
};
use tempfile::tempdir;

use crate::warnings::assert_one;
use crate::{normalize, put, steps, write};

/// The episodes of these numbers, each of 20 steps and as many as its number. One of three terminates.
fn walks(numbers: Range<usize>) -> Arrays {
    let mut arrays = steps(0, 2, 1);
    for number in numbers {
        let state = |step: usize| {
            let time = (step + 5 * number) as f32;
            [(0.3 * time).sin(), (0.2 * time).cos()]
        };
        for step in 0..20 + number {
            let is_last = step == 19 + number;
            arrays.observations.extend(state(step));
            arrays.actions.push((7.0 * step as f32).cos());
            arrays.next_observations.extend(state(step + 1));
            arrays.rewards.push((number + step) as f32 / 10.0);
            arrays.terminals.push(is_last && number % 3 == 1);
            arrays.timeouts.push(is_last && number % 3 != 1);
        }
    }
    arrays
}

fn split(paths: &[&Path], held_out: &[usize]) -> Result<Split, DatasetError> {
    let options = ReadOptions { normalize: normalize("aor"), ..ReadOptions::default() };
    Transitions::read_split(paths, &options, HoldOut::Episodes(held_out))
}

fn windows(transitions: &Transitions) -> Batch {
    let window = Window { history: 2, length: 3, gamma: 0.9 };
    transitions.gather_windows(&Vec::from_iter(0..transitions.len() as u32), window)
}

#[test]
fn files_give_the_transitions_of_one_file_with_their_episodes() {
    let folder = tempdir().unwrap();
    let [a, b, whole] = ["a", "b", "whole"].map(|name| folder.path().join(name));
    for own in [false, true] {
        for (path, numbers) in [(&a, 0..4), (&b, 4..9), (&whole, 0..9)] {
            match own {
                true => write_own(path, walks(numbers), Names::default()).unwrap(),
                false => drop(write(path, &walks(numbers))),
            }
        }
        let [joined, one] = [&[&*a, &b][..], &[&whole]].map(|paths| split(paths, &[1, 5]).unwrap());
        for (joined, one) in
            [(joined.training, one.training), (joined.held_out.unwrap(), one.held_out.unwrap())]
        {
            assert_eq!(windows(&joined), windows(&one), "own: {own}");
            assert_eq!(joined.statistics(), one.statistics());
            assert_eq!(joined.scaling(), one.scaling());
            assert_eq!(joined.episodes(), one.episodes());
            assert_eq!(joined.warnings(), [""; 0]);
        }
        let [a, b] = &joined.files[..] else { panic!("two files") };
        assert_eq!([a.episodes, b.episodes], [4, 5]);
        assert_eq!(a.transitions + b.transitions, one.files[0].transitions);
    }
}

/// Noise in a file's next observations is no reset, though the other has none. An episode without
/// flags ends with its file. Rewards may be all alike in a file.
#[test]
fn each_file_is_read_and_doubted_by_itself() {
    let folder = tempdir().unwrap();
    let [exact, noisy] = ["exact", "noisy"].map(|name| folder.path().join(name));
    let mut arrays = walks(20..21);
    let next = arrays.next_observations.iter_mut().enumerate();
    next.for_each(|(i, x)| *x += 0.01 * (1.7 * i as f32).sin());
    arrays.rewards.fill(0.0);
    write_own(&exact, walks(0..9), Names::default()).unwrap();
    write_own(&noisy, arrays, Names::default()).unwrap();
    hdf5::File::open_rw(&noisy).unwrap().unlink("timeouts").unwrap();
    for paths in [[&*exact, &noisy], [&noisy, &exact]] {
        let joined = split(&paths, &[]).unwrap().training;
        assert_eq!((joined.episodes().len(), joined.warnings()), (10, &[][..]));
    }
    let error = split(&[&noisy], &[]).err().unwrap().to_string();
    assert!(error.ends_with("one endless episode"), "{error}");

    for path in [&exact, &noisy] {
        write(path, &walks(0..9));
    }
    hdf5::File::open_rw(&noisy).unwrap().unlink("timeouts").unwrap();
    let warnings = split(&[&exact, &noisy], &[]).unwrap().training.warnings().to_vec();
    assert_eq!(inspect(&[&exact, &noisy], None).unwrap().problems, warnings);
    assert_one(&warnings, &format!("{}: no array `timeouts`", noisy.display()), "");
}

#[test]
fn files_that_do_not_fit_are_refused() {
    let folder = tempdir().unwrap();
    let [a, b] = ["a", "b"].map(|name| folder.path().join(name));
    let named = |path: &Path, names: &[&str]| {
        let observations = names.iter().map(|name| name.to_string()).collect();
        write_own(path, walks(0..3), Names { observations, actions: Vec::new() }).unwrap();
    };
    let recorded = |path: &Path, group: &str, array: &str, text: &str| {
        let file = write(path, &walks(0..3));
        let text: VarLenUnicode = text.parse().unwrap();
        put(&file.create_group(group).unwrap(), array, &[1], &[text]);
    };
    let assert_refused = |difference: &str| {
        let error = split(&[&a, &b], &[]).err().unwrap().to_string();
        let (own, other) = (b.display(), a.display());
        assert_eq!(error, format!("{own}: does not fit {other} ({difference})"));
    };
    named(&a, &["angle", "speed"]);
    named(&b, &["speed", "angle"]);
    assert_refused("observation_names: speed, angle, not angle, speed");
    let mut wide = steps(9, 3, 1);
    wide.timeouts[8] = true;
    write_own(&b, wide, Names::default()).unwrap();
    assert_refused("numbers of observations: 3, not 2");
    write(&b, &walks(0..3));
    assert_refused("next observations: the next row's, not stored");
    recorded(&a, "infos", "goal", "");
    assert_refused("an episode after its goal: ends, not goes on");
    recorded(&a, "metadata", "environment", "hopper");
    recorded(&b, "metadata", "environment", "walker2d");
    assert_refused("environment: walker2d, not hopper");
}
