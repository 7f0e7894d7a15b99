use quad_dataset::{Arrays, Inspection, Normalize, inspect};

use super::{O, assert_warned, cart, observe, training_warnings, warnings, write_as};
use crate::scratch;

const NONE: Normalize = Normalize { actions: false, observations: false, rewards: false };

/// Nothing is wrong if training normalizes.
fn assert_remedied(arrays: &Arrays, normalize: Normalize) {
    assert_eq!(training_warnings(arrays, true, normalize), [""; 0]);
}

#[test]
fn rewards_that_are_all_alike() {
    let mut cart = cart(false);
    let alike = "so nothing distinguishes good from bad";
    cart.rewards.fill(1.0);
    let expected =
        format!("array `rewards`: all are alike (1), {alike} but how soon an episode terminates");
    assert_eq!(warnings(&cart, true), [expected]);
    cart.rewards.fill(0.0);
    let remedy = "; `--algorithm diffusion-policy` clones without rewards";
    let expected = format!("array `rewards`: all are alike (0), {alike}{remedy}");
    assert_eq!(warnings(&cart, false), [expected]);
    cart.rewards[70] = 1e-1;
    assert_eq!(warnings(&cart, false), [""; 0]);
    let mut rise = |step: f64| {
        for (row, reward) in cart.rewards.iter_mut().enumerate() {
            *reward = (0.1 + step * row as f64) as f32;
        }
        warnings(&cart, false)
    };
    assert!(rise(1e-9)[0].starts_with("array `rewards`: all are alike (0.1)"));
    assert_eq!(rise(1e-7), [""; 0]);
}

#[test]
fn observations_too_large_or_too_small_to_train_on_as_they_are() {
    let mut cart = cart(false);
    observe(&mut cart, |row| {
        (row[1], row[2], row[3]) = (1e6 + 1e3 * row[1], 50.0 + 1e-4 * row[2], 90.0 * row[3])
    });
    let found = warnings(&cart, true);
    for (warning, start) in found.iter().zip([
        "array `observations`: far from ±1 in column 1, of size 999980, which",
        "array `observations`: hardly changes in column 2, by a standard deviation of",
    ]) {
        assert!(warning.starts_with(start), "{warning}, not {start}");
        assert!(warning.contains("--normalize observations"), "{warning}");
    }
    assert_eq!(found.len(), 2);
    assert_remedied(&cart, Normalize { observations: true, ..NONE });
    observe(&mut cart, |row| (row[1], row[2]) = (1e-6 * (row[1] - 1e6), 0.0));
    assert_warned(&cart, true, "array `observations`: hardly changes in column 1", "");
    observe(&mut cart, |row| row[1] *= 1e4);
    assert_eq!(warnings(&cart, true), [""; 0]);
}

#[test]
fn a_few_rows_far_from_all_others() {
    let mut cart = cart(false);
    // The second observation of one row, which is also what followed the row before.
    cart.observations[7 * O + 1] = 1e6;
    cart.next_observations[6 * O + 1] = 1e6;
    let start = "array `observations`, row 7: 1000000 in column 1, far from nearly all other rows;";
    assert_warned(&cart, true, start, "a sensor's error");
    let normalize = Normalize { observations: true, ..NONE };
    assert!(training_warnings(&cart, true, normalize)[0].starts_with(start));
}

#[test]
fn actions_too_small_to_learn() {
    let mut cart = cart(false);
    cart.actions.chunks_exact_mut(2).for_each(|action| action[1] *= 1e-4);
    let start = "array `actions`: hardly changes in column 1";
    assert_warned(&cart, true, start, "--normalize actions");
    assert_remedied(&cart, Normalize { actions: true, ..NONE });
}

#[test]
fn an_action_that_alone_sets_the_range() {
    let mut cart = cart(false);
    cart.actions[7 * 2 + 1] = 200.0;
    let start =
        "array `actions`, row 7: 200 in column 1, far from nearly all other rows; normalized";
    let normalize = Normalize { actions: true, ..NONE };
    let warnings = training_warnings(&cart, true, normalize);
    assert!(warnings.len() == 1 && warnings[0].starts_with(start), "{warnings:?}");
    cart.actions[7 * 2 + 1] = 2.0;
    assert_remedied(&cart, normalize);
}

#[test]
fn rewards_of_a_size_that_methods_are_not_made_for() {
    let mut cart = cart(false);
    let scale = |cart: &mut Arrays, by: f32| cart.rewards.iter_mut().for_each(|x| *x *= by);
    scale(&mut cart, 400.0);
    assert_warned(&cart, true, "array `rewards`: of size", "episodes return -");
    assert_warned(&cart, true, "array `rewards`", "`learner train --normalize rewards`");
    assert_remedied(&cart, Normalize { rewards: true, ..NONE });
    scale(&mut cart, 1e-6);
    assert_warned(&cart, false, "array `rewards`", "1 for good and bad actions alike");
    // Rare rewards of ordinary size are not small.
    cart.rewards.fill(0.0);
    cart.rewards[100] = 1.0;
    assert_eq!(warnings(&cart, false), [""; 0]);
}

#[test]
fn numbers_that_never_change_are_named() {
    let (_folder, path) = scratch("cart.hdf5");
    let mut cart = cart(false);
    observe(&mut cart, |row| (row[1], row[3]) = (0.1, 90.0));
    cart.actions.chunks_exact_mut(2).for_each(|action| action[1] = 0.3);
    assert_eq!(warnings(&cart, true), [""; 0]);
    write_as(&path, &cart, true);
    let inspection = inspect(&path, None).unwrap();
    let page = inspection.to_string();
    let Inspection { constant_observations, constant_actions, .. } = inspection;
    assert_eq!((constant_observations, constant_actions), (vec![1, 3], vec![1]));
    assert!(page.contains("observations  4 numbers; constant: columns 1, 3\n"), "{page}");
    assert!(page.contains("actions       2 numbers; constant: column 1\n"), "{page}");
    assert!(page.contains("rewards       of size 0."), "{page}");
}
