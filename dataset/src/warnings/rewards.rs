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

fn rewards(recording: &Recording) -> impl Iterator<Item = f32> {
    recording.steps().map(|row| recording.rewards[row])
}

pub(super) fn alike(recording: &Recording) -> Option<String> {
    let first = rewards(recording).next()?;
    let least = rewards(recording).fold(first, f32::min);
    let most = rewards(recording).fold(first, f32::max);
    let is_finite = rewards(recording).all(f32::is_finite);
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
    let first = rewards(recording).next()?;
    let other = rewards(recording).find(|reward| *reward != first)?;
    let high = first.max(other);
    // Goal tasks are checked by their flags.
    if recording.goal || rewards(recording).any(|reward| reward != first && reward != other) {
        return None;
    }
    let (mut count, mut after, mut stay) = (0, 0, 0);
    // A goal's reward is low, then high.
    let (mut starts_low, mut is_reached) = (None, false);
    for row in recording.steps() {
        let is_high = recording.rewards[row] == high;
        count += 1;
        after += usize::from(is_reached);
        stay += usize::from(is_reached && is_high);
        is_reached |= *starts_low.get_or_insert(!is_high) && is_high;
        if recording.ends[row] {
            (starts_low, is_reached) = (None, false);
        }
    }
    (after as f64 > MOST_AFTER_GOAL * count as f64 && stay as f64 > STAYS * after as f64).then(|| {
        format!(
            "array `rewards`: {} of the rows come after the first reward of {high} in their episode, as if after its goal, so few lead \
             to it; if the task is over there, end each episode at that row with `{}`",
            percent(after, count),
            recording.terminal_array
        )
    })
}

pub(super) fn size(recording: &Recording) -> Option<String> {
    let size = RewardScaling::default().rms(recording);
    let reward = |row: usize| recording.rewards[row].abs();
    let largest = recording.transitions().map(reward).fold(0.0, f32::max);
    let weights = match size > LARGEST {
        true => "exp(β · advantage) is then 0 or cut off",
        false if largest > 0.0 && largest < SMALLEST => {
            "exp(β · advantage) is then 1 for good and bad actions alike"
        }
        false => return None,
    };
    let sums = recording.episodes().into_iter().map(|episode| episode.sum);
    let returns = Summary::new(&Vec::from_iter(sums));
    Some(format!(
        "array `rewards`: of size {} a step (root mean square; episodes return {} to {}), where methods are made for about 1: \
         {weights}; `learner train --normalize rewards` divides them by it",
        short(size),
        short(returns.min),
        short(returns.max)
    ))
}
