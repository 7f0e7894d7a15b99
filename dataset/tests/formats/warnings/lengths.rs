use quad_dataset::{Arrays, HoldOut, Names, ReadOptions, Transitions, inspect, write_own};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::rows::reordered;
use super::{O, assert_one, assert_warned, cart, mass, problems, resize, warnings, without_name};
use crate::{put, scratch, write};

/// Episodes that end where the time limit of `mass` does, as a `done` that does not tell them apart.
fn done(length: usize) -> Arrays {
    let mut done = mass(length, 0.1);
    for (terminal, timeout) in done.terminals.iter_mut().zip(&mut done.timeouts) {
        *terminal |= std::mem::take(timeout);
    }
    done
}

#[test]
fn terminals_at_the_time_limit() {
    for own in [false, true] {
        let start = "array `terminals`: 30 of 30";
        assert_warned(&done(20), own, start, "stand exactly at the longest length");
    }
    // Most reach the goal before.
    assert_eq!(warnings(&done(400), true), [""; 0]);
}

#[test]
fn resets_that_no_flag_marks() {
    let mut cart = cart(false);
    // Two of three ends are timeouts.
    cart.timeouts.fill(false);
    let part = "is a timeout missing?";
    assert_warned(&cart, true, "array `next_observations`, row ", part);
    let start = "array `observations`, row 209: the next state is as far away as after a reset";
    assert_one(&problems(&cart, false), start, "");
}

#[test]
fn leaps_that_are_no_resets() {
    // An angle that wraps around, four times in an episode.
    let mut cart = cart(false);
    for (row, state) in cart.observations.chunks_exact_mut(O).enumerate() {
        state[1] = (row % 10) as f32 - 5.0;
    }
    assert_eq!(problems(&cart, false), [""; 0]);
}

/// A file of our own layout without `timeouts`, and its episodes and problems.
fn without_timeouts(arrays: &Arrays) -> (usize, Vec<String>) {
    let (_folder, path) = scratch("own.hdf5");
    write_own(&path, arrays.clone(), Names::default()).unwrap();
    hdf5::File::open_rw(&path).unwrap().unlink("timeouts").unwrap();
    let inspection = inspect(&[&path], None).unwrap();
    let transitions = Transitions::read(&path, &ReadOptions::default()).unwrap();
    assert_eq!(without_name(transitions.warnings(), &path), inspection.problems);
    (inspection.episodes, inspection.problems)
}

#[test]
fn next_observations_with_noise_end_no_episode() {
    let exact = cart(false);
    let mut random = ChaCha8Rng::seed_from_u64(9);
    let mut noisy = |size: f32| {
        let mut arrays = exact.clone();
        let mut draw = || size * random.random_range(-1.0..1.0);
        let next = arrays.next_observations.iter_mut();
        next.for_each(|x| *x += draw());
        without_timeouts(&arrays)
    };
    for size in [0.0, 1e-4, 1e-3] {
        assert_eq!(noisy(size), (30, Vec::new()), "{size}");
    }
    let (_, problems) = noisy(0.1);
    let start = "array `next_observations`: is not the state of the next row in 9";
    assert_one(&problems, start, "write `timeouts`");
}

#[test]
fn rows_out_of_order_are_episodes_of_a_step() {
    let sound = cart(false);
    let rows = sound.rewards.len();
    let (episodes, problems) = without_timeouts(&reordered(&sound, |row| row * 7919 % rows));
    assert_eq!(episodes, rows);
    assert!(problems[0].contains("rows out of order"), "{problems:?}");
}

#[test]
fn ends_that_d3rlpy_wrote() {
    let (_folder, path) = scratch("d3rlpy.h5");
    let cart = cart(false);
    let file = write(&path, &cart);
    file.unlink("timeouts").unwrap();
    let start = "no array `timeouts`: an episode is taken to end at a terminal alone";
    assert_eq!(inspect(&[&path], None).unwrap().problems[0], start);
    let rows = cart.rewards.len();
    let is_end = |row: usize| f32::from(cart.terminals[row] || cart.timeouts[row]);
    let ends = Vec::from_iter((0..rows).map(is_end));
    put(&file, "episode_terminals", &[rows], &ends);
    drop(file);
    let inspection = inspect(&[&path], None).unwrap();
    assert_eq!((inspection.episodes, inspection.problems), (30, Vec::new()));
}

#[test]
fn a_chunk_longer_than_every_episode_and_a_single_episode() {
    let (_folder, path) = scratch("own.hdf5");
    write_own(&path, cart(false), Names::default()).unwrap();
    let with = |chunk| ReadOptions { chunk, ..ReadOptions::default() };
    let split = |chunk| {
        let hold_out = HoldOut::Fraction(0.1);
        Transitions::read_split(&[&path], &with(chunk), hold_out).unwrap()
    };
    // Episodes have up to 46 steps.
    assert_eq!(split(46).training.warnings(), [""; 0]);
    let start = "no episode has the 47 steps of a chunk, the longest 46: ";
    assert_one(&without_name(split(47).training.warnings(), &path), start, "");
    let mut single = cart(false);
    resize(&mut single, 40);
    write_own(&path, single, Names::default()).unwrap();
    let split = split(1);
    assert!(split.held_out.is_none());
    let warning = "a single episode: none is held out";
    assert_eq!(split.training.warnings(), [warning]);
}
