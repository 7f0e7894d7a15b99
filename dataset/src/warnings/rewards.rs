//! Constant rewards, rewards after the goal, and rewards of unusual size.

use super::ends::MOST_AFTER_GOAL;
use super::{percent, short};
use crate::recording::Recording;
use crate::statistics::Summary;
use crate::tables::reward::RewardScaling;

/// Relative difference that float32 critics lose: Q-values are some hundred times the rewards.
const ALIKE: f32 = 2e-5;
/// Largest accepted root mean square, and smallest accepted maximum. Published rules for locomotion
/// and mazes give a root mean square of about 1.
const LARGEST: f64 = 30.0;
const SMALLEST: f32 = 0.01;
/// Fraction of the rows after reaching the goal that must be at the goal.
const STAYS: f64 = 0.9;

/// Reward of each step, and true at the end of an episode.
fn steps(recording: &Recording) -> impl Iterator<Item = (f32, bool)> {
    let rows = (0..recording.rows()).filter(|&row| recording.is_step(row));
    rows.map(|row| (recording.rewards[row], recording.ends[row]))
}

pub(super) fn alike(recording: &Recording) -> Option<String> {
    let (first, _) = steps(recording).next()?;
    let rewards = || steps(recording).map(|(reward, _)| reward);
    let (least, most) = (rewards().fold(first, f32::min), rewards().fold(first, f32::max));
    let is_finite = rewards().all(f32::is_finite);
    let but = match recording.terminals.contains(&true) && first != 0.0 {
        true => " but how soon an episode terminates",
        false => "; `--algorithm diffusion-policy` clones without rewards",
    };
    (is_finite && most - least <= ALIKE * most.abs().max(least.abs())).then(|| {
        format!(
            "array `rewards`: all are alike ({first}), so nothing distinguishes good from bad{but}"
        )
    })
}

/// Sparse goal rewards in recordings that mostly continue after the goal.
pub(super) fn after_goal(recording: &Recording) -> Option<String> {
    let (first, _) = steps(recording).next()?;
    let (other, _) = steps(recording).find(|(reward, _)| *reward != first)?;
    let high = first.max(other);
    // Goal tasks are checked by their flags.
    if recording.goal || steps(recording).any(|(reward, _)| reward != first && reward != other) {
        return None;
    }
    let (mut all, mut after, mut stay) = (0, 0, 0);
    // A goal's reward is low, then high.
    let (mut starts_low, mut is_reached) = (None, false);
    for (reward, ends) in steps(recording) {
        let is_high = reward == high;
        all += 1;
        after += usize::from(is_reached);
        stay += usize::from(is_reached && is_high);
        is_reached |= *starts_low.get_or_insert(!is_high) && is_high;
        if ends {
            (starts_low, is_reached) = (None, false);
        }
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

pub(super) fn size(recording: &Recording) -> Option<String> {
    let size = RewardScaling::default().rms(recording);
    let rewards = recording.transitions().map(|row| recording.rewards[row].abs());
    let largest = rewards.fold(0.0, f32::max);
    let weights = match size > LARGEST {
        true => "exp(β · advantage) is then 0 or cut off",
        false if largest > 0.0 && largest < SMALLEST => {
            "exp(β · advantage) is then 1 for good and bad actions alike"
        }
        false => return None,
    };
    let sums = recording.episodes().into_iter().map(|episode| episode.sum);
    let returns = Summary::of(&Vec::from_iter(sums));
    Some(format!(
        "array `rewards`: of size {} a step (root mean square; episodes return {} to {}), where methods are made for about 1: \
         {weights}; `learner train --normalize rewards` divides them by it",
        short(size),
        short(returns.min),
        short(returns.max)
    ))
}
