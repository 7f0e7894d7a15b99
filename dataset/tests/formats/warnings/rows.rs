use quad_dataset::{Arrays, inspect};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{O, assert_sound, assert_warned, empty, mass, problems, record, warnings};
use crate::{put, scratch, write};

/// Sound data with the observation of each row taken `from` another, by the row and its number in
/// the episode.
fn moved(sound: Arrays, from: impl Fn(usize, usize) -> usize) -> Arrays {
    let rows = sound.rewards.len();
    let (mut observations, mut start) = (Vec::new(), 0);
    for row in 0..rows {
        let taken = from(row, row - start);
        observations.extend_from_slice(&sound.observations[taken * O..(taken + 1) * O]);
        if sound.terminals[row] || sound.timeouts[row] {
            start = row + 1;
        }
    }
    let mut next_observations = observations[O..].to_vec();
    next_observations.extend_from_within((rows - 2) * O..);
    Arrays { observations, next_observations, ..sound }
}

fn any(warnings: &[String], start: &str) -> bool {
    warnings.iter().any(|warning| warning.starts_with(start))
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
    still.actions.chunks_exact_mut(2).for_each(|action| action.copy_from_slice(&[0.25, 0.5]));
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
    for (values, width) in [
        (&mut arrays.observations, O),
        (&mut arrays.next_observations, O),
        (&mut arrays.actions, 2),
        (&mut arrays.rewards, 1),
    ] {
        values.resize(rows * width, 0.0);
    }
    for flags in [&mut arrays.terminals, &mut arrays.timeouts] {
        flags.resize(rows, false);
    }
    for own in [false, true] {
        assert!(any(&problems(&arrays, own), "array `observations`: 0 in the last 100 rows ("));
    }
    arrays.timeouts[rows - 1] = true;
    assert!(!any(&problems(&arrays, true), "array `observations`: 0 in"));
}

#[test]
fn actions_that_are_the_state() {
    let degrees = 180.0 / std::f32::consts::PI;
    for (unit, own) in [(1.0, false), (1.0, true), (100.0, true), (degrees, true)] {
        let mut copied = mass(60, 0.1);
        let states = copied.observations.chunks_exact(O);
        copied.actions = states.flat_map(|state| [unit * state[1], unit * state[0]]).collect();
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
        let problems = problems(&arrays, true);
        assert!(!problems.iter().any(|problem| problem.contains("copied")), "{problems:?}");
    }
}

#[test]
fn observations_that_are_a_row_late() {
    for (length, seconds) in [(60, 0.1), (300, 0.02)] {
        let sound = mass(length, seconds);
        assert_sound("mass", &sound);
        let is_last = Vec::from_iter(
            (0..sound.rewards.len()).map(|row| sound.terminals[row] || sound.timeouts[row]),
        );
        let late = moved(sound, |row, _| if is_last[row] { row } else { row + 1 });
        for own in [false, true] {
            assert!(any(&problems(&late, own), "array `observations`: one row late?"));
        }
    }
}

#[test]
fn rows_out_of_order_are_not_called_late() {
    let (mut random, mut sound) = (ChaCha8Rng::seed_from_u64(5), empty());
    for _ in 0..30 {
        let state = [random.random_range(-2.0..2.0), random.random_range(-2.0..2.0), 0.0, 0.0];
        record(&mut sound, 40, state, |[x, y, ..]| {
            // The next action says where the next state is.
            let mut act = |x: f32| -0.4 * x + random.random_range(-0.2_f32..0.2);
            let action = [act(x), act(y)];
            (action, [x + 0.1 * action[0], y + 0.1 * action[1], 0.0, 0.0], -x.hypot(y), false)
        });
    }
    let rows = sound.rewards.len();
    let place = |row: usize| row * 7919 % rows;
    let shuffled = |values: &[f32], width: usize| -> Vec<f32> {
        (0..rows).flat_map(|row| values[place(row) * width..][..width].to_vec()).collect()
    };
    let next_observations = shuffled(&sound.next_observations, O);
    let arrays = Arrays {
        observations: shuffled(&sound.observations, O),
        actions: shuffled(&sound.actions, 2),
        rewards: shuffled(&sound.rewards, 1),
        timeouts: (0..rows).map(|row| sound.timeouts[place(row)]).collect(),
        ..sound.clone()
    };
    let (_folder, path) = scratch("shuffled.hdf5");
    let file = write(&path, &arrays);
    put(&file, "next_observations", &[rows, O], &next_observations);
    drop(file);
    let problems = inspect(&path, None).unwrap().problems;
    let [problem] = &problems[..] else { panic!("{problems:?}") };
    assert!(problem.starts_with("array `next_observations`, row 0: not the"), "{problem}");
}
