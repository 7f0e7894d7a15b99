use super::*;
use crate::recording::RowKind::{Dropped, LastState, Transition};
use crate::recording::tests::recording;

fn transitions(recording: Recording) -> Transitions {
    let scaling = RewardRule::AsIs.scaling(&[]).unwrap();
    Transitions::new(recording, None, scaling, Scaling::default())
}

/// D4RL: 0 1 2(timeout) | 3 4(terminal) | 5 6(the last row).
fn d4rl() -> Recording {
    let mut recording =
        recording(&[Transition, Transition, Dropped, Transition, Transition, Transition, Dropped]);
    recording.timeouts[2] = true;
    recording.terminals[4] = true;
    recording.ends[2] = true;
    recording.ends[4] = true;
    recording
}

#[test]
fn episodes_end_at_timeouts_terminals_and_the_end_of_the_file() {
    let transitions = transitions(d4rl());
    assert_eq!(transitions.episodes(), [0..2, 2..4, 4..5]);
    assert_eq!(transitions.recorded_episodes(), transitions.episodes());
    let next: Vec<_> = (0..5).map(|index| transitions.next(index)).collect();
    assert_eq!(next, [Some(1), None, Some(3), None, None]);
}

#[test]
fn a_dropped_step_gives_its_action_to_the_transition_that_leads_to_it() {
    let transitions = transitions(d4rl());
    let action = |index| transitions.next_action(index).map(|action| action[0]);
    let actions = Vec::from_iter((0..5).map(action));
    let expected = [Some(0.01), Some(0.02), Some(0.04), None, Some(0.06)];
    assert_eq!(actions, expected, "after a terminal there is none");
}

#[test]
fn the_last_state_of_an_episode_is_no_step() {
    let mut recording = recording(&[Transition, Transition, LastState, Transition, LastState]);
    recording.ends[1] = true;
    recording.ends[3] = true;
    let transitions = transitions(recording);
    assert_eq!(transitions.episodes(), [0..2, 2..3]);
    assert_eq!((transitions.next_action(0), transitions.next_action(1)), (Some(&[0.01][..]), None));
}

#[test]
fn an_episode_ends_at_the_goal_although_the_recording_goes_on() {
    let mut recording = recording(&[Transition, Transition, Transition, Dropped]);
    recording.goal = true;
    recording.terminals[1] = true;
    recording.ends[3] = true;
    let transitions = transitions(recording);
    assert_eq!(transitions.episodes(), [0..2, 2..3]);
    assert_eq!(transitions.recorded_episodes(), transitions.episodes()[..1]);
    assert!(transitions.next_action(1).is_none());
}

#[test]
fn an_episode_after_one_that_reached_its_goal_is_one_of_the_recording() {
    let mut recording =
        recording(&[Transition, Transition, Dropped, Transition, Transition, Dropped]);
    recording.goal = true;
    (recording.terminals[0], recording.ends[2], recording.ends[5]) = (true, true, true);
    let transitions = transitions(recording);
    assert_eq!(transitions.episodes(), [0..1, 1..2, 2..4]);
    assert_eq!(transitions.recorded_episodes(), [0..1, 2..4]);
}

#[test]
fn rows_with_next_observations_of_their_own_follow_one_another_where_these_say_so() {
    let mut recording = recording(&[Transition; 4]);
    recording.next_observations = Some(vec![1.0, 9.0, 3.0, 4.0]);
    let transitions = transitions(recording);
    assert_eq!(transitions.episodes(), [0..2, 2..4]);
    assert_eq!((transitions.next_action(1), transitions.next_action(3)), (None, None));
}

#[test]
fn windows_lie_within_episodes() {
    let transitions = transitions(d4rl());
    assert_eq!(transitions.window_starts(1), [0, 1, 2, 3, 4]);
    assert_eq!(transitions.window_starts(2), [0, 2]);
    assert!(transitions.window_starts(3).is_empty());
    let mut batch = Batch::default();
    transitions.gather(&Vec::from_iter(2..4), &mut batch);
    assert_eq!((batch.observations, batch.next_observations), (vec![3.0, 4.0], vec![4.0, 5.0]));
}

#[test]
fn standard_units_are_of_the_rows_that_are_learned_from() {
    let units = transitions(d4rl()).standard_units();
    // Mean square of 0, 1, 3, 4 and 5: 10.2; mean: 2.6. Actions are a hundredth of that.
    for (affine, unit) in [(units.observations, 1.0), (units.actions, 0.01)] {
        let affine = affine.unwrap();
        let (mean, deviation) = (affine.offset[0] / unit, affine.scale[0] / unit);
        let apart = (mean - 2.6).abs().max((deviation - 3.44_f32.sqrt()).abs());
        assert!(apart < 1e-5, "{affine:?}");
    }
}
