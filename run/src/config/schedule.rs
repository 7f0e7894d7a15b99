//! How many gradient steps a run has, and after which of them its policy is evaluated.

/// A run's gradient steps and evaluations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Schedule {
    /// Gradient steps.
    pub steps: u64,
    /// Gradient steps between two evaluations; 0: none at all.
    pub eval_interval: u64,
}

impl Schedule {
    /// Whether the policy after that gradient step is evaluated.
    pub fn is_evaluated(&self, step: u64) -> bool {
        let is_due = step == self.steps || step.is_multiple_of(self.eval_interval);
        self.eval_interval > 0 && (1..=self.steps).contains(&step) && is_due
    }

    /// How many policies are evaluated.
    pub fn evaluations(self) -> u64 {
        if self.eval_interval == 0 { 0 } else { self.steps.div_ceil(self.eval_interval) }
    }

    /// The steps whose policies are evaluated, in ascending order.
    pub fn evaluated_steps(self) -> impl Iterator<Item = u64> {
        let Self { steps, eval_interval } = self;
        let regular =
            (1..=steps.checked_div(eval_interval).unwrap_or(0)).map(move |n| n * eval_interval);
        let last = eval_interval > 0 && !steps.is_multiple_of(eval_interval);
        regular.chain(last.then_some(steps))
    }
}

#[cfg(test)]
mod tests;
