//! Tests of `live/evaluators.rs`.

use super::*;
use crate::live::metrics::Metrics;

fn name(number: usize) -> Name {
    Name::new(format!("e-{number}")).unwrap()
}

#[test]
fn many_that_come_and_go_are_told_in_one_line_and_bounded() {
    let (metrics, _) = Metrics::new(&Name::new("run").unwrap(), 1, &[]).unwrap();
    let now = Instant::now();
    let mut evaluators = Evaluators::new(metrics.evaluators, now);
    for number in 0..2 * MOST_EVALUATORS {
        assert_eq!(evaluators.joined(name(number)).is_ok(), number < MOST_EVALUATORS);
    }
    for number in 0..2 * MOST_EVALUATORS {
        evaluators.left(&name(number), 0);
    }
    assert_eq!(evaluators.tick(now).len(), ONE_BY_ONE, "the period is not over");
    let more =
        format!("{} more evaluators came and {MOST_EVALUATORS} left", MOST_EVALUATORS - ONE_BY_ONE);
    assert_eq!(evaluators.tick(now + PERIOD), [more]);
    evaluators.joined(name(7)).unwrap();
    assert_eq!(evaluators.tick(now + PERIOD), ["evaluator e-7 is here"], "a new period");
}

/// A run that is trained waits for an evaluator which is at a long job of another run, and not for
/// one that can do nothing here.
#[test]
fn an_evaluator_may_do_the_work_until_it_asks_for_other_work() {
    let (metrics, _) = Metrics::new(&Name::new("run").unwrap(), 1, &[]).unwrap();
    let mut evaluators = Evaluators::new(metrics.evaluators, Instant::now());
    let fits =
        |evaluators: &Evaluators| evaluators.present().map(|(_, fits, _)| fits).collect::<Vec<_>>();
    evaluators.asks(&name(1), true);
    assert!(!evaluators.any_may_fit(), "it is not here");
    evaluators.joined(name(1)).unwrap();
    assert_eq!((evaluators.any_may_fit(), fits(&evaluators)), (true, vec![false]));
    evaluators.asks(&name(1), false);
    assert_eq!((evaluators.any_may_fit(), fits(&evaluators)), (false, vec![false]));
    evaluators.joined(name(2)).unwrap();
    evaluators.asks(&name(2), true);
    assert_eq!((evaluators.any_may_fit(), fits(&evaluators)), (true, vec![false, true]));
    evaluators.left(&name(2), 0);
    assert!(!evaluators.any_may_fit());
}
