//! Which evaluations of a run are its score.

use clap::ValueEnum;
use serde::Serialize;

/// Which evaluations of a run count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Select {
    /// The last ones, as in the paper
    Last,
    /// The best one: optimistic, because it is chosen by the very scores that are reported
    Best,
}

impl Select {
    /// What a reader has to know before the figures, if they are not the paper's protocol.
    pub fn warning(self) -> Option<&'static str> {
        const SELECTED: &str = "Selected: of each run its best complete evaluation counts, in place of the mean of its last ones. It is chosen by the very \
             scores that are reported, so it is optimistic, and the more so the more evaluations there are.\n";
        (self == Self::Best).then_some(SELECTED)
    }
}
