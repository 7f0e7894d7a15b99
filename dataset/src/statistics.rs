/// Minimum, mean and maximum; NaN without numbers.
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

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Episode {
    pub(crate) length: usize,
    pub(crate) sum: f64,
    reached: bool,
}

impl Episode {
    /// Adds a step. With a `goal`, rewards after the first positive one do not count.
    pub(crate) fn push(&mut self, reward: f64, goal: bool) {
        self.length += 1;
        if !self.reached {
            self.sum += reward;
        }
        self.reached |= goal && reward > 0.0;
    }
}

/// Undiscounted returns of pairs (reward, end of episode), including an unfinished last episode.
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
