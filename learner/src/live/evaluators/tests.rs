//! Tests of `live/evaluators.rs`.

use super::*;
use crate::live::metrics::Metrics;

fn name(number: usize) -> Name {
    Name::new(format!("e-{number}")).unwrap()
}

#[test]
fn many_that_come_and_go_are_told_in_one_line_and_bounded() {
    let (metrics, _) = Metrics::new(&Name::new("run").unwrap(), 1, &[], false).unwrap();
    let now = Instant::now();
    let mut evaluators = Evaluators::new(metrics.evaluators, now);
    for number in 0..2 * MOST_EVALUATORS {
        assert_eq!(evaluators.joined(name(number)).is_ok(), number < MOST_EVALUATORS);
    }
    for number in 0..2 * MOST_EVALUATORS {
        evaluators.left(&name(number), 0);
    }
    assert_eq!(evaluators.tick(now).len(), ONE_BY_ONE, "the period is not over");
    let more = format!("{} more evaluators came and {MOST_EVALUATORS} left", MOST_EVALUATORS - ONE_BY_ONE);
    assert_eq!(evaluators.tick(now + PERIOD), [more]);
    evaluators.joined(name(7)).unwrap();
    assert_eq!(evaluators.tick(now + PERIOD), ["evaluator e-7 is here"], "a new period");
}
