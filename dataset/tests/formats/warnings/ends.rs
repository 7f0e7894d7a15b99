use super::{O, assert_warned, cart, mass, warnings};

#[test]
fn a_mask_or_a_discount_in_place_of_the_flag() {
    for own in [false, true] {
        let mut mask = mass(60, 0.1);
        mask.terminals.iter_mut().for_each(|flag| *flag = !*flag);
        let part = "a mask or a discount (1 − done) in place of the flag? write 1 − it";
        assert_warned(&mask, own, "array `terminals`: says in 9", part);
        // A mask of truncated episodes is 1 everywhere.
        mask.terminals.fill(true);
        let start = "array `terminals`: says in 100 % of the rows";
        assert_warned(&mask, own, start, part);
    }
}

#[test]
fn a_success_that_stays_set_and_rows_after_the_goal() {
    let (mut set, mut reached, mut number) = (cart(false), cart(false), 0);
    for row in 0..set.rewards.len() {
        reached.rewards[row] = f32::from(number >= 3);
        set.terminals[row] = number >= 30;
        number += 1;
        if reached.terminals[row] || reached.timeouts[row] {
            number = 0;
        }
    }
    for own in [false, true] {
        let part = "a success that stays set after the goal? end each episode at the first";
        assert_warned(&set, own, "array `terminals`: says in", part);
        assert_warned(&reached, own, "array `rewards`: 90.6", "few lead to it");
    }
    // A fall has a cost, and most rows are before it.
    let falls = reached.terminals.iter();
    reached.rewards = falls.map(|fall| f32::from(!fall)).collect();
    assert_eq!(warnings(&reached, true), [""; 0]);
}

#[test]
fn flags_that_are_a_row_out_of_step_with_the_resets() {
    for (name, own) in [("terminals", false), ("timeouts", false), ("timeouts", true)] {
        let mut cart = cart(false);
        for (rows, side) in [(1_isize, "late"), (-2, "early")] {
            let flags = match name {
                "terminals" => &mut cart.terminals,
                _ => &mut cart.timeouts,
            };
            let length = flags.len() as isize;
            flags.rotate_right(rows.rem_euclid(length) as usize);
            let start = format!("array `{name}`: one row {side}");
            assert_warned(&cart, own, &start, "");
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
