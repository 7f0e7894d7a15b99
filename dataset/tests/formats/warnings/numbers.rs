use quad_dataset::{Arrays, inspect};

use super::{
    O, act, assert_one, assert_warned, cart, observe, training_warnings, warnings, write_as,
};
use crate::{normalize, scratch};

/// Nothing is wrong if training normalizes these columns.
fn assert_remedied(arrays: &Arrays, columns: &str) {
    let warnings = training_warnings(arrays, true, normalize(columns));
    assert_eq!(warnings, [""; 0]);
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
        let rewards = (0..cart.rewards.len()).map(|row| (0.1 + step * row as f64) as f32);
        cart.rewards = rewards.collect();
        warnings(&cart, false)
    };
    assert_one(&rise(1e-9), "array `rewards`: all are alike (0.1)", "");
    assert_eq!(rise(1e-7), [""; 0]);
}

#[test]
fn observations_too_large_or_too_small_to_train_on_as_they_are() {
    let mut cart = cart(false);
    observe(&mut cart, |row| {
        row[1] = 1e6 + 1e3 * row[1];
        row[2] = 50.0 + 1e-4 * row[2];
        row[3] *= 90.0;
    });
    let warnings = warnings(&cart, true);
    assert_eq!(warnings.len(), 2);
    let start = "array `observations`: far from ±1 in column 1, of size 999980, which";
    assert_one(&warnings[..1], start, "--normalize observations");
    let start = "array `observations`: hardly changes in column 2, by a standard deviation of";
    assert_one(&warnings[1..], start, "--normalize observations");
    assert_remedied(&cart, "o");
    observe(&mut cart, |row| row[1] = 1e-6 * (row[1] - 1e6));
    observe(&mut cart, |row| row[2] = 0.0);
    let start = "array `observations`: hardly changes in column 1";
    assert_warned(&cart, true, start, "");
    observe(&mut cart, |row| row[1] *= 1e4);
    assert_eq!(super::warnings(&cart, true), [""; 0]);
}

#[test]
fn a_few_rows_far_from_all_others() {
    let mut cart = cart(false);
    // The second observation of one row, which is also what followed the row before.
    cart.observations[7 * O + 1] = 1e6;
    cart.next_observations[6 * O + 1] = 1e6;
    let start = "array `observations`, row 7: 1000000 in column 1, far from nearly all other rows;";
    assert_warned(&cart, true, start, "a sensor's error");
    let warnings = training_warnings(&cart, true, normalize("o"));
    assert!(warnings[0].starts_with(start), "{warnings:?}");
}

#[test]
fn actions_too_small_to_learn_or_one_that_alone_sets_the_range() {
    let mut small = cart(false);
    act(&mut small, |action| action[1] *= 1e-4);
    let start = "array `actions`: hardly changes in column 1";
    assert_warned(&small, true, start, "--normalize actions");
    assert_remedied(&small, "a");

    let mut cart = cart(false);
    cart.actions[7 * 2 + 1] = 200.0;
    let start =
        "array `actions`, row 7: 200 in column 1, far from nearly all other rows; normalized";
    assert_one(&training_warnings(&cart, true, normalize("a")), start, "");
    cart.actions[7 * 2 + 1] = 2.0;
    assert_remedied(&cart, "a");
}

#[test]
fn rewards_of_a_size_that_methods_are_not_made_for() {
    let mut cart = cart(false);
    let scale = |cart: &mut Arrays, by: f32| cart.rewards.iter_mut().for_each(|x| *x *= by);
    scale(&mut cart, 400.0);
    let start = "array `rewards`: of size";
    assert_warned(&cart, true, start, "episodes return -");
    assert_warned(&cart, true, start, "`learner train --normalize rewards`");
    assert_remedied(&cart, "r");
    scale(&mut cart, 1e-6);
    assert_warned(&cart, false, start, "1 for good and bad actions alike");
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
    act(&mut cart, |action| action[1] = 0.3);
    assert_eq!(warnings(&cart, true), [""; 0]);
    write_as(&path, &cart, true);
    let inspection = inspect(&[&path], None).unwrap();
    assert_eq!(inspection.constant_observations, [1, 3]);
    assert_eq!(inspection.constant_actions, [1]);
    let page = inspection.to_string();
    for line in [
        "observations  4 numbers; constant: columns 1, 3\n",
        "actions       2 numbers; constant: column 1\n",
        "rewards       of size 0.",
    ] {
        assert!(page.contains(line), "{page}");
    }
}
