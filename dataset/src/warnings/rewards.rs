//! Rewards that tell nothing apart, that mostly come after the goal, or of a size that methods are
//! not made for.

use super::ends::MOST_AFTER_GOAL;
use super::{percent, short};
use crate::recording::Recording;
use crate::statistics::Extent;
use crate::tables::reward::RewardScaling;

/// Differences that are smaller, of the rewards' size, are lost in float32 by critics, whose values
/// are some hundred times as large.
const ALIKE: f32 = 2e-5;
/// The largest root mean square that nothing is said of, and the smallest largest reward. The
/// published rules for locomotion and mazes give a root mean square of about 1.
const LARGEST: f64 = 30.0;
const SMALLEST: f32 = 0.01;
/// The share of rows after the first at the goal that must be there, too.
const STAYS: f64 = 0.9;

/// What an episode has had of two rewards so far.
#[derive(Clone, Copy, PartialEq)]
enum Goal {
    /// Nothing.
    New,
    /// The lower reward alone.
    Ahead,
    /// The lower one, then the higher one.
    Reached,
    /// The higher one at its beginning, so that this is no goal.
    None,
}

/// The reward of each step, and whether its episode ends there.
fn steps(recording: &Recording) -> impl Iterator<Item = (f32, bool)> {
    let rows = (0..recording.rows()).filter(|&row| recording.is_step(row));
    rows.map(|row| (recording.rewards[row], recording.ends[row]))
}

/// Rewards that are all alike.
pub(super) fn alike(recording: &Recording) -> Option<String> {
    let (first, _) = steps(recording).next()?;
    let (least, most) =
        steps(recording).fold((first, first), |(least, most), (x, _)| (least.min(x), most.max(x)));
    let is_finite = steps(recording).all(|(reward, _)| reward.is_finite());
    let terminals = recording.terminals.contains(&true) && first != 0.0;
    let but = if terminals { " but how soon an episode terminates" } else { "" };
    (is_finite && most - least <= ALIKE * most.abs().max(least.abs())).then(|| {
        format!(
            "array `rewards`: all are alike ({first}), so nothing distinguishes good from bad{but}"
        )
    })
}

/// Rewards of two values, the higher of which an episode keeps from some step on: nearly all steps
/// come after that one.
pub(super) fn after_goal(recording: &Recording) -> Option<String> {
    let (first, _) = steps(recording).next()?;
    let (other, _) = steps(recording).find(|(reward, _)| *reward != first)?;
    let high = first.max(other);
    // Of a task with a goal, flags tell.
    if recording.goal || steps(recording).any(|(reward, _)| reward != first && reward != other) {
        return None;
    }
    let (mut all, mut after, mut stay, mut goal) = (0, 0, 0, Goal::New);
    for (reward, ends) in steps(recording) {
        let is_after = goal == Goal::Reached;
        all += 1;
        after += usize::from(is_after);
        stay += usize::from(is_after && reward == high);
        goal = match (goal, reward == high) {
            _ if ends => Goal::New,
            (Goal::New, true) => Goal::None,
            (Goal::New, false) => Goal::Ahead,
            (Goal::Ahead, true) => Goal::Reached,
            (goal, _) => goal,
        };
    }
    (after as f64 > MOST_AFTER_GOAL * all as f64 && stay as f64 > STAYS * after as f64).then(|| {
        format!(
            "array `rewards`: {} of the rows come after the first reward of {high} in their episode, as if after its goal, so few lead \
             to it; if the task is over there, end each episode at that row with `{}`",
            percent(after, all),
            recording.terminal_array
        )
    })
}

/// Rewards that are too large or too small.
pub(super) fn size(recording: &Recording) -> Option<String> {
    let size = RewardScaling::default().size(recording);
    let largest = recording
        .transitions()
        .map(|row| recording.rewards[row as usize].abs())
        .fold(0.0, f32::max);
    let weights = match size > LARGEST {
        true => "exp(β · advantage) is then 0 or cut off",
        false if largest > 0.0 && largest < SMALLEST => {
            "exp(β · advantage) is then 1 for good and bad actions alike"
        }
        false => return None,
    };
    let returns = Extent::of(recording.episodes().iter().map(|episode| episode.sum));
    Some(format!(
        "array `rewards`: of size {} a step (root mean square; episodes return {} to {}), where methods are made for about 1: \
         {weights}; `learner train --normalize rewards` divides them by it",
        short(size),
        short(returns.min),
        short(returns.max)
    ))
}
