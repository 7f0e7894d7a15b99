use quad_dataset::{Arrays, inspect};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{
    O, act, assert_one, assert_sound, assert_warned, empty, mass, problems, record, resize,
    warnings,
};
use crate::{put, scratch, write};

/// Sound data with the observation of each row taken `from` another, by the row and its number in
/// the episode.
fn moved(mut sound: Arrays, from: impl Fn(usize, usize) -> usize) -> Arrays {
    let rows = sound.rewards.len();
    let (mut observations, mut start) = (Vec::new(), 0);
    for row in 0..rows {
        let taken = from(row, row - start);
        observations.extend_from_slice(&sound.observations[taken * O..(taken + 1) * O]);
        if sound.terminals[row] || sound.timeouts[row] {
            start = row + 1;
        }
    }
    sound.next_observations = observations[O..].to_vec();
    sound.next_observations.extend_from_within((rows - 2) * O..);
    sound.observations = observations;
    sound
}

fn any(warnings: &[String], start: &str) -> bool {
    warnings.iter().any(|warning| warning.starts_with(start))
}

/// The rows of `arrays` in the order in which `place` says where they are taken from, but not their
/// flags.
pub(super) fn reordered(arrays: &Arrays, place: impl Fn(usize) -> usize) -> Arrays {
    let rows = arrays.rewards.len();
    let mut reordered = arrays.clone();
    for row in 0..rows {
        let from = place(row);
        let states = |row: usize| row * O..(row + 1) * O;
        reordered.observations[states(row)].copy_from_slice(&arrays.observations[states(from)]);
        let next = &arrays.next_observations[states(from)];
        reordered.next_observations[states(row)].copy_from_slice(next);
        let actions = &arrays.actions[2 * from..][..2];
        reordered.actions[2 * row..][..2].copy_from_slice(actions);
        reordered.rewards[row] = arrays.rewards[from];
    }
    reordered
}

#[test]
fn observations_that_rest_while_actions_change() {
    let rests = "array `observations`: does not change in";
    for own in [false, true] {
        let chunks = moved(mass(60, 0.1), |row, number| row - number % 10);
        assert_warned(&chunks, own, &format!("{rests} 90."), "a chunk's start");
        let pairs = moved(mass(60, 0.1), |row, number| row - number % 2);
        assert_warned(&pairs, own, rests, "");
    }
    // A robot at rest is commanded to rest.
    let mut still = moved(mass(60, 0.1), |row, number| row - number % 10);
    act(&mut still, |action| action.copy_from_slice(&[0.25, 0.5]));
    assert!(!any(&warnings(&still, true), rests));
}

#[test]
fn next_observations_that_are_the_rows_own() {
    let mut own = mass(60, 0.1);
    own.next_observations = own.observations.clone();
    let start = "array `next_observations`: is the observation of its own row in 100 %";
    assert!(any(&problems(&own, true), start));
}

#[test]
fn rows_that_were_never_written() {
    let mut arrays = mass(60, 0.1);
    let rows = arrays.rewards.len() + 100;
    resize(&mut arrays, rows);
    let start = "array `observations`: 0 in the last 100 rows (";
    assert!(any(&problems(&arrays, false), start) && any(&problems(&arrays, true), start));
    arrays.timeouts[rows - 1] = true;
    assert!(!any(&problems(&arrays, true), "array `observations`: 0 in"));
}

#[test]
fn actions_that_are_the_state() {
    let degrees = 180.0 / std::f32::consts::PI;
    for (unit, own) in [(1.0, false), (1.0, true), (100.0, true), (degrees, true)] {
        let mut copied = mass(60, 0.1);
        let states = copied.observations.chunks_exact(O);
        let actions = states.flat_map(|state| [unit * state[1], unit * state[0]]);
        copied.actions = actions.collect();
        let start = "array `actions`: columns 0, 1 copied from columns 1, 0 of the same row's observation (in 100.0 %";
        assert!(any(&problems(&copied, own), start));
    }
    // The next state is a valid command.
    let mut commands = mass(60, 0.1);
    let next = commands.next_observations.chunks_exact(O);
    commands.actions = next.flat_map(|state| [state[0], state[1]]).collect();
    // A gripper's state equals its command except while moving.
    let mut gripper = mass(60, 0.1);
    let open = |row: usize| f32::from(u8::from(row % 40 < 20));
    for row in 0..gripper.rewards.len() {
        gripper.observations[row * O + 3] = open(row);
        gripper.next_observations[row * O + 3] = open(row + 1);
        gripper.actions[row * 2 + 1] = open(row + 1);
    }
    for arrays in [commands, gripper] {
        let problems = problems(&arrays, true).concat();
        assert!(!problems.contains("copied"), "{problems}");
    }
}

#[test]
fn observations_that_are_a_row_late() {
    for (length, seconds) in [(60, 0.1), (300, 0.02)] {
        let sound = mass(length, seconds);
        assert_sound("mass", &sound);
        let is_last = |row: usize| sound.terminals[row] || sound.timeouts[row];
        let late = moved(sound.clone(), |row, _| row + usize::from(!is_last(row)));
        for own in [false, true] {
            let problems = problems(&late, own);
            assert!(any(&problems, "array `observations`: one row late?"));
        }
    }
}

#[test]
fn rows_out_of_order_are_not_called_late() {
    let (mut random, mut sound) = (ChaCha8Rng::seed_from_u64(5), empty());
    for _ in 0..30 {
        let [x, y] = [0; 2].map(|_| random.random_range(-2.0..2.0));
        record(&mut sound, 40, [x, y, 0.0, 0.0], |[x, y, ..]| {
            // The next action says where the next state is.
            let action = [x, y].map(|x| -0.4 * x + random.random_range(-0.2_f32..0.2));
            let next = [x + 0.1 * action[0], y + 0.1 * action[1], 0.0, 0.0];
            (action, next, -x.hypot(y), false)
        });
    }
    let rows = sound.rewards.len();
    let place = |row: usize| row * 7919 % rows;
    let mut arrays = reordered(&sound, place);
    arrays.timeouts = (0..rows).map(|row| sound.timeouts[place(row)]).collect();
    let (_folder, path) = scratch("shuffled.hdf5");
    let (file, next) = (write(&path, &arrays), &arrays.next_observations);
    put(&file, "next_observations", &[rows, O], next);
    drop(file);
    let problems = inspect(&[&path], None).unwrap().problems;
    assert_one(&problems, "array `next_observations`, row 0: not the", "");
}
