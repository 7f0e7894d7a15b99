//! Figures of episodes.

/// The smallest, mean and largest of some numbers; NaN where there are none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Extent {
    pub(crate) min: f64,
    pub(crate) mean: f64,
    pub(crate) max: f64,
}

impl Extent {
    pub(crate) fn of(values: impl Iterator<Item = f64>) -> Self {
        let (mut count, mut sum, mut min, mut max) = (0.0, 0.0, f64::NAN, f64::NAN);
        for value in values {
            (count, sum) = (count + 1.0, sum + value);
            (min, max) = (value.min(min), value.max(max));
        }
        Self { min, mean: sum / count, max }
    }
}

/// An episode while it is added up.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Episode {
    /// Steps.
    pub(crate) length: usize,
    /// Its undiscounted return.
    pub(crate) sum: f64,
    reached: bool,
}

impl Episode {
    /// Adds a step. With a `goal`, the first positive reward says that it is reached, and later
    /// ones do not count.
    pub(crate) fn push(&mut self, reward: f64, goal: bool) {
        self.length += 1;
        if !self.reached {
            self.sum += reward;
        }
        self.reached |= goal && reward > 0.0;
    }
}

/// Sums of rewards up to each end, given (reward, whether the run ends here) in order. What follows
/// the last end is a run too.
pub(crate) fn returns(rewards: impl Iterator<Item = (f32, bool)>) -> Vec<f64> {
    let mut finished = Vec::new();
    let mut open = None;
    for (reward, ends) in rewards {
        let sum = open.take().unwrap_or(0.0) + f64::from(reward);
        if ends {
            finished.push(sum);
        } else {
            open = Some(sum);
        }
    }
    finished.extend(open);
    finished
}
