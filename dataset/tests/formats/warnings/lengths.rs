use quad_dataset::{
    Arrays, HoldOut, Inspection, Names, ReadOptions, Transitions, inspect, write_own,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{O, assert_warned, cart, mass, problems, warnings};
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
    let length = |cart: &Arrays| problems(cart, false);
    assert_eq!(length(&cart), [""; 0]);
    // Two of three ends are timeouts.
    cart.timeouts.fill(false);
    let part = "is a timeout missing?";
    assert_warned(&cart, true, "array `next_observations`, row ", part);
    let start = "array `observations`, row 209: the next state is as far away as after a reset";
    let problems = length(&cart);
    assert!(problems.len() == 1 && problems[0].starts_with(start), "{problems:?}");
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
    let file = hdf5::File::open_rw(&path).unwrap();
    file.unlink("timeouts").unwrap();
    drop(file);
    let Inspection { episodes, problems, .. } = inspect(&path, None).unwrap();
    let transitions = Transitions::read(&path, &ReadOptions::default()).unwrap();
    assert_eq!(transitions.warnings(), problems);
    (episodes, problems)
}

#[test]
fn next_observations_with_noise_end_no_episode() {
    let exact = cart(false);
    let mut random = ChaCha8Rng::seed_from_u64(9);
    let mut noisy = |size: f32| {
        let mut noisy = exact.clone();
        noisy
            .next_observations
            .iter_mut()
            .for_each(|x| *x += size * random.random_range(-1.0..1.0));
        without_timeouts(&noisy)
    };
    for size in [0.0, 1e-4, 1e-3] {
        assert_eq!(noisy(size), (30, Vec::new()), "{size}");
    }
    let (_, problems) = noisy(0.1);
    let start = "array `next_observations`: is not the state of the next row in 9";
    let [problem] = &problems[..] else { panic!("{problems:?}") };
    assert!(problem.starts_with(start) && problem.contains("write `timeouts`"), "{problem}");
}

#[test]
fn rows_out_of_order_are_episodes_of_a_step() {
    let sound = cart(false);
    let rows = sound.rewards.len();
    let shuffled = |values: &[f32], width: usize| -> Vec<f32> {
        (0..rows).flat_map(|row| values[row * 7919 % rows * width..][..width].to_vec()).collect()
    };
    let arrays = Arrays {
        observations: shuffled(&sound.observations, O),
        next_observations: shuffled(&sound.next_observations, O),
        actions: shuffled(&sound.actions, 2),
        rewards: shuffled(&sound.rewards, 1),
        ..sound
    };
    let (episodes, problems) = without_timeouts(&arrays);
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
    assert_eq!(inspect(&path, None).unwrap().problems[0], start);
    let ends = cart.terminals.iter().zip(&cart.timeouts).map(|(a, b)| f32::from(*a || *b));
    put(&file, "episode_terminals", &[cart.rewards.len()], &Vec::from_iter(ends));
    drop(file);
    let Inspection { episodes, problems, .. } = inspect(&path, None).unwrap();
    assert_eq!((episodes, problems), (30, Vec::new()));
}

#[test]
fn a_chunk_longer_than_every_episode_and_a_single_episode() {
    let (_folder, path) = scratch("own.hdf5");
    write_own(&path, cart(false), Names::default()).unwrap();
    let with = |chunk| ReadOptions { chunk, ..ReadOptions::default() };
    // Episodes have up to 46 steps.
    for (chunk, start) in
        [(46, None), (47, Some("no episode has the 47 steps of a chunk, the longest 46: "))]
    {
        let transitions = Transitions::read(&path, &with(chunk)).unwrap();
        let warnings = transitions.warnings();
        let is_start = |start: &str| warnings.len() == 1 && warnings[0].starts_with(start);
        assert!(start.map_or(warnings.is_empty(), is_start), "{warnings:?}");
    }
    let split = |hold_out| Transitions::read_split(&path, &with(1), hold_out).unwrap();
    assert_eq!(split(HoldOut::Fraction(0.1)).training.warnings(), [""; 0]);
    let rows = 40;
    let mut one = cart(false);
    for (values, width) in [
        (&mut one.observations, O),
        (&mut one.next_observations, O),
        (&mut one.actions, 2),
        (&mut one.rewards, 1),
    ] {
        values.truncate(rows * width);
    }
    one.terminals.truncate(rows);
    one.timeouts.truncate(rows);
    write_own(&path, one, Names::default()).unwrap();
    let split = Transitions::read_split(&path, &with(1), HoldOut::Fraction(0.1)).unwrap();
    assert!(split.held_out.is_none());
    assert_eq!(split.training.warnings(), ["a single episode: none is held out"]);
}
