//! Tests of `config/schedule.rs`.

use super::*;

#[test]
fn the_steps_that_are_listed_are_those_that_are_evaluated() {
    for (steps, eval_interval, expected) in
        [(10, 5, &[5, 10][..]), (10, 4, &[4, 8, 10]), (10, 20, &[10]), (3, 1, &[1, 2, 3]), (10, 0, &[])]
    {
        let schedule = Schedule { steps, eval_interval };
        assert_eq!(Vec::from_iter(schedule.evaluated_steps()), expected, "{schedule:?}");
        let evaluated = (1..=steps).filter(|step| schedule.is_evaluated(*step));
        assert_eq!(Vec::from_iter(evaluated), expected, "{schedule:?}");
    }
}
