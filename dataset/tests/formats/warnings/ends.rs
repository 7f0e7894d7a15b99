use quad_dataset::Arrays;

use super::{O, assert_warned, cart, mass, warnings};

#[test]
fn a_mask_or_a_discount_in_place_of_the_flag() {
    for own in [false, true] {
        let mut mask = mass(60, 0.1);
        mask.terminals.iter_mut().for_each(|terminal| *terminal = !*terminal);
        let part = "a mask or a discount (1 − done) in place of the flag? write 1 − it";
        assert_warned(&mask, own, "array `terminals`: says in 9", part);
        // A mask of truncated episodes is 1 everywhere.
        mask.terminals.fill(true);
        assert_warned(&mask, own, "array `terminals`: says in 100 % of the rows", part);
    }
}

#[test]
fn a_success_that_stays_set() {
    for own in [false, true] {
        let (mut cart, mut since) = (cart(false), 0);
        for row in 0..cart.rewards.len() {
            since += 1;
            cart.terminals[row] = since > 30;
            if cart.timeouts[row] {
                since = 0;
            }
        }
        let part = "a success that stays set after the goal? end each episode at the first";
        assert_warned(&cart, own, "array `terminals`: says in", part);
    }
}

#[test]
fn rows_after_the_goal() {
    let (mut cart, mut number) = (cart(false), 0);
    for row in 0..cart.rewards.len() {
        cart.rewards[row] = f32::from(number >= 3);
        number = if cart.terminals[row] || cart.timeouts[row] { 0 } else { number + 1 };
    }
    for own in [false, true] {
        assert_warned(&cart, own, "array `rewards`: 90.6", "few lead to it");
    }
    // A fall has a cost, and most rows are before it.
    cart.rewards = cart.terminals.iter().map(|fall| f32::from(!fall)).collect();
    assert_eq!(warnings(&cart, true), [""; 0]);
}

#[test]
fn flags_that_are_a_row_out_of_step_with_the_resets() {
    type Flags = fn(&mut Arrays) -> &mut Vec<bool>;
    let (terminals, timeouts): (Flags, Flags) =
        (|arrays| &mut arrays.terminals, |arrays| &mut arrays.timeouts);
    for (flags, name) in [(terminals, "terminals"), (timeouts, "timeouts")] {
        for own in [false, true] {
            let mut cart = cart(false);
            flags(&mut cart).rotate_right(1);
            assert_warned(&cart, own, &format!("array `{name}`: one row late"), "");
            flags(&mut cart).rotate_left(2);
            assert_warned(&cart, own, &format!("array `{name}`: one row early"), "");
        }
    }
    // Without visible resets, flags cannot be judged.
    let mut kept = cart(true);
    kept.timeouts.rotate_right(1);
    assert_eq!(warnings(&kept, false), [""; 0]);
}

#[test]
fn crashes_are_no_resets() {
    // The step before a termination is as long as a reset.
    let mut cart = cart(false);
    for row in (1..cart.rewards.len()).filter(|&row| cart.terminals[row]) {
        cart.observations[row * O] += 3.0;
    }
    assert_eq!(warnings(&cart, false), [""; 0]);
}
