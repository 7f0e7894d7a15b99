//! The evaluations of a run that make its score.

use clap::ValueEnum;
use serde::Serialize;

/// The evaluations of a run that make its score. (The help of `learner report` has these lines.)
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Select {
    /// The last ones, as in the paper
    Last,
    /// The best one: optimistic, because it is chosen by the very scores that are reported
    Best,
}

impl Select {
    /// A warning for the reader of figures that do not follow the paper's protocol.
    pub fn warning(self) -> Option<&'static str> {
        const SELECTED: &str = "Selected: of each run its best complete evaluation counts, in place of the mean of its last ones. It is chosen by the very \
             scores that are reported, so it is optimistic, and the more so the more evaluations there are.\n";
        (self == Self::Best).then_some(SELECTED)
    }
}
