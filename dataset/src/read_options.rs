//! What a reader of transitions knows of the run.

use crate::normalize::Normalize;
use crate::tables::environment::EnvironmentSpec;
use crate::tables::maze::MazeTask;
use crate::tables::reward::RewardRule;

/// Options of [`Transitions::read`](crate::Transitions::read).
#[derive(Clone, Copy, Debug, Default)]
pub struct ReadOptions {
    /// Environment that provides dimensions, time limit and reference returns. Without it the
    /// dimensions are the source's, and a file without timeouts has none.
    pub environment: Option<&'static EnvironmentSpec>,
    /// Maze task that replaces the source's rewards and masks.
    pub task: Option<MazeTask>,
    /// Map from the source's rewards to those that are trained on.
    pub reward: RewardRule,
    /// Columns to normalize. Actions that are not normalized must be within [-1, 1].
    pub normalize: Normalize,
    /// Steps of a chunk that will be learned; 0 if that is not known.
    pub chunk: usize,
}
