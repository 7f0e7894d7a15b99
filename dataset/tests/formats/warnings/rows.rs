use super::{Cart, O, mass};

fn moved(cart: &Cart, from: impl Fn(usize, usize) -> usize) -> Cart {
    let rows = cart.rewards.len();
    let (mut observations, mut start) = (Vec::new(), 0);
    for row in 0..rows {
        let taken = from(row, row - start);
        observations.extend_from_slice(&cart.observations[taken * O..(taken + 1) * O]);
        if cart.terminals[row] || cart.timeouts[row] {
            start = row + 1;
        }
    }
    let mut next_observations = observations[O..].to_vec();
    next_observations.extend_from_within((rows - 2) * O..);
    Cart {
        observations,
        next_observations,
        actions: cart.actions.clone(),
        rewards: cart.rewards.clone(),
        terminals: cart.terminals.clone(),
        timeouts: cart.timeouts.clone(),
    }
}

#[test]
fn observations_that_rest_while_actions_change() {
    for own in [false, true] {
        let chunks = moved(&mass(60, 0.1), |row, number| row - number % 10);
        let warning = chunks.warning(own);
        assert!(warning.starts_with("array `observations`: does not change in 90."), "{warning}");
        assert!(warning.contains("a chunk's start"), "{warning}");
        let pairs = moved(&mass(60, 0.1), |row, number| row - number % 2);
        assert!(pairs.warning(own).starts_with("array `observations`: does not change in"));
    }
    // A robot at rest is commanded to rest.
    let mut still = moved(&mass(60, 0.1), |row, number| row - number % 10);
    still.actions.chunks_exact_mut(2).for_each(|action| action.copy_from_slice(&[0.25, 0.5]));
    assert!(!still.warnings(true).iter().any(|warning| warning.contains("does not change")));
}

#[test]
fn next_observations_that_are_the_rows_own() {
    let mut cart = mass(60, 0.1);
    cart.next_observations = cart.observations.clone();
    let warnings = cart.problems(true);
    assert!(warnings.iter().any(|warning| {
        warning.starts_with("array `next_observations`: is the observation of its own row in 100 %")
    }));
}

#[test]
fn actions_that_are_the_state() {
    for (unit, own) in
        [(1.0, false), (1.0, true), (100.0, true), (180.0 / std::f32::consts::PI, true)]
    {
        let mut cart = mass(60, 0.1);
        let (actions, observations) = (&mut cart.actions, &cart.observations);
        for (action, observation) in actions.chunks_exact_mut(2).zip(observations.chunks_exact(O)) {
            action.copy_from_slice(&[unit * observation[1], unit * observation[0]]);
        }
        let warnings = cart.problems(own);
        let expected = "array `actions`: columns 0, 1 copied from columns 1, 0 of the same row's observation (in 100.0 %";
        assert!(warnings.iter().any(|warning| warning.starts_with(expected)), "{warnings:?}");
    }
    // The next state is a valid command.
    let mut cart = mass(60, 0.1);
    for (action, next) in
        cart.actions.chunks_exact_mut(2).zip(cart.next_observations.chunks_exact(O))
    {
        action.copy_from_slice(&next[..2]);
    }
    assert!(!cart.problems(true).iter().any(|warning| warning.contains("copied")));
    // A gripper's state equals its command except while moving.
    let mut cart = mass(60, 0.1);
    let open = |row: usize| f32::from(u8::from(row % 40 < 20));
    for row in 0..cart.rewards.len() {
        cart.observations[row * O + 3] = open(row);
        cart.next_observations[row * O + 3] = open(row + 1);
        cart.actions[row * 2 + 1] = open(row + 1);
    }
    assert!(!cart.problems(true).iter().any(|warning| warning.contains("copied")));
}

#[test]
fn observations_that_are_a_row_late() {
    for (steps, seconds) in [(60, 0.1), (300, 0.02)] {
        let sound = mass(steps, seconds);
        let last = sound.rewards.len() - 1;
        let is_last = |row: usize| sound.terminals[row] || sound.timeouts[row];
        let late = moved(&sound, |row, _| if is_last(row) { row } else { (row + 1).min(last) });
        for own in [false, true] {
            assert_eq!(sound.warnings(own), [""; 0]);
            let warnings = late.problems(own);
            assert!(
                warnings
                    .iter()
                    .any(|warning| warning.starts_with("array `observations`: one row late?")),
                "{warnings:?}"
            );
        }
    }
}
