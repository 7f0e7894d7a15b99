//! Gradient steps and evaluations of a run.

/// The evaluated steps among all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Schedule {
    /// The gradient step that the run begins after.
    pub start: u64,
    /// The last gradient step.
    pub steps: u64,
    /// Gradient steps between two evaluations; 0 turns evaluations off.
    pub eval_interval: u64,
}

impl Schedule {
    /// True if the policy after a gradient step is evaluated.
    pub fn is_evaluated(&self, step: u64) -> bool {
        let is_due = step == self.steps || step.is_multiple_of(self.eval_interval);
        self.eval_interval > 0 && step > self.start && step <= self.steps && is_due
    }

    /// Number of evaluated policies.
    pub fn evaluations(self) -> u64 {
        let Self { start, steps, eval_interval } = self;
        match eval_interval {
            0 => 0,
            interval => steps.div_ceil(interval) - start / interval,
        }
    }

    /// The evaluated steps, in ascending order.
    pub fn evaluated_steps(self) -> impl Iterator<Item = u64> {
        let Self { start, steps, eval_interval } = self;
        let skipped = start.checked_div(eval_interval).unwrap_or(0);
        let count = steps.checked_div(eval_interval).unwrap_or(0);
        let regular = (skipped + 1..=count).map(move |n| n * eval_interval);
        let last = eval_interval > 0 && !steps.is_multiple_of(eval_interval);
        regular.chain(last.then_some(steps))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn evaluations_of_a_run_without_end_are_counted() {
        let endless = |steps, eval_interval| Schedule { start: 0, steps, eval_interval };
        assert_eq!(endless(u64::MAX, 1).evaluations(), u64::MAX);
        assert_eq!(endless(1_000_000_000_001, 1000).evaluations(), 1_000_000_001);
    }

    #[test]
    fn evaluated_steps() {
        for (start, steps, eval_interval, expected) in [
            (0, 10, 5, &[5, 10][..]),
            (0, 10, 4, &[4, 8, 10]),
            (0, 10, 20, &[10]),
            (0, 3, 1, &[1, 2, 3]),
            (0, 10, 0, &[]),
            (4, 10, 4, &[8, 10]),
            (5, 10, 4, &[8, 10]),
            (5, 10, 20, &[10]),
        ] {
            let schedule = Schedule { start, steps, eval_interval };
            let listed = Vec::from_iter(schedule.evaluated_steps());
            assert_eq!(listed, expected, "{schedule:?}");
            assert_eq!(schedule.evaluations(), listed.len() as u64);
            let evaluated = (0..=2 * steps).filter(|step| schedule.is_evaluated(*step));
            assert_eq!(Vec::from_iter(evaluated), expected, "{schedule:?}");
        }
    }
}
