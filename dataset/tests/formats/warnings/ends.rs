use super::{Cart, O, mass};

#[test]
fn a_mask_or_a_discount_in_place_of_the_flag() {
    for own in [false, true] {
        let mut cart = mass(60, 0.1);
        cart.terminals.iter_mut().for_each(|terminal| *terminal = !*terminal);
        let warning = cart.warning(own);
        assert!(warning.starts_with("array `terminals`: says in 9"), "{warning}");
        assert!(
            warning.contains("a mask or a discount (1 − done) in place of the flag? write 1 − it"),
            "{warning}"
        );
        // A mask of truncated episodes is 1 everywhere.
        cart.terminals.fill(true);
        assert!(cart.warning(own).starts_with("array `terminals`: says in 100 % of the rows"));
    }
}

#[test]
fn a_success_that_stays_set() {
    for own in [false, true] {
        let mut cart = Cart::new(false);
        let mut since = 0;
        for row in 0..cart.rewards.len() {
            since += 1;
            cart.terminals[row] = since > 30;
            if cart.timeouts[row] {
                since = 0;
            }
        }
        let warning = cart.warning(own);
        assert!(
            warning
                .contains("a success that stays set after the goal? end each episode at the first"),
            "{warning}"
        );
    }
}

#[test]
fn rows_after_the_goal() {
    let mut cart = Cart::new(false);
    let mut number = 0;
    for row in 0..cart.rewards.len() {
        cart.rewards[row] = f32::from(number >= 3);
        number = if cart.terminals[row] || cart.timeouts[row] { 0 } else { number + 1 };
    }
    let warning = cart.warning(true);
    assert!(
        warning.starts_with("array `rewards`: 90.6") && warning.contains("few lead to it"),
        "{warning}"
    );
    assert_eq!(cart.warning(false), warning);
    // A fall has a cost, and most rows are before it.
    cart.rewards
        .iter_mut()
        .zip(&cart.terminals)
        .for_each(|(reward, fall)| *reward = f32::from(!fall));
    assert_eq!(cart.warnings(true), [""; 0]);
}

#[test]
fn flags_that_are_a_row_out_of_step_with_the_resets() {
    type Flags = fn(&mut Cart) -> &mut Vec<bool>;
    let (terminals, timeouts): (Flags, Flags) =
        (|cart| &mut cart.terminals, |cart| &mut cart.timeouts);
    for (flags, name) in [(terminals, "terminals"), (timeouts, "timeouts")] {
        for own in [false, true] {
            let mut cart = Cart::new(false);
            flags(&mut cart).rotate_right(1);
            assert!(cart.warning(own).starts_with(&format!("array `{name}`: one row late")));
            flags(&mut cart).rotate_left(2);
            assert!(cart.warning(own).starts_with(&format!("array `{name}`: one row early")));
        }
    }
    // Without visible resets, flags cannot be judged.
    let mut kept = Cart::new(true);
    kept.timeouts.rotate_right(1);
    assert_eq!(kept.warnings(false), [""; 0]);
}

#[test]
fn crashes_are_no_resets() {
    // The step before a termination is as long as a reset.
    let mut cart = Cart::new(false);
    for row in (1..cart.rewards.len()).filter(|&row| cart.terminals[row]) {
        cart.observations[row * O] += 3.0;
    }
    assert_eq!(cart.warnings(false), [""; 0]);
}
