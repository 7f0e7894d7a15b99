//! Tests of `config/schedule.rs`.

use super::*;

/// A run that is to go on until its user stops it.
#[test]
fn the_evaluations_of_a_run_without_end_are_counted_and_not_listed() {
    assert_eq!(Schedule { steps: u64::MAX, eval_interval: 1 }.evaluations(), u64::MAX);
    assert_eq!(
        Schedule { steps: 1_000_000_000_001, eval_interval: 1000 }.evaluations(),
        1_000_000_001
    );
}

#[test]
fn the_steps_that_are_listed_are_those_that_are_evaluated() {
    for (steps, eval_interval, expected) in [
        (10, 5, &[5, 10][..]),
        (10, 4, &[4, 8, 10]),
        (10, 20, &[10]),
        (3, 1, &[1, 2, 3]),
        (10, 0, &[]),
    ] {
        let schedule = Schedule { steps, eval_interval };
        assert_eq!(Vec::from_iter(schedule.evaluated_steps()), expected, "{schedule:?}");
        assert_eq!(schedule.evaluations(), expected.len() as u64, "{schedule:?}");
        let evaluated = (0..=2 * steps).filter(|step| schedule.is_evaluated(*step));
        assert_eq!(Vec::from_iter(evaluated), expected, "{schedule:?}");
    }
}
