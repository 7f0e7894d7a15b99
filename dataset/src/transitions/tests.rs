//! Episodes, windows, scaling and experience of transitions.

use quad_kernels::scaling::Affine;

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

/// Actions are a hundredth of row numbers.
#[test]
#[allow(clippy::single_range_in_vec_init)] // It is one episode.
fn episodes_and_next_actions_are_those_of_the_recording() {
    let recorded_rows = |kinds: &[RowKind], terminals: &[usize], ends: &[usize], goal: bool| {
        let mut recording = recording(kinds);
        recording.goal = goal;
        terminals.iter().for_each(|row| recording.terminals[*row] = true);
        ends.iter().for_each(|row| recording.ends[*row] = true);
        recording
    };
    let (t, d, last) = (Transition, Dropped, LastState);
    let mut stored = recording(&[t; 4]);
    stored.store_next(vec![1.0, 9.0, 3.0, 4.0]);
    for (recording, episodes, recorded, next_actions) in [
        // A timeout, a terminal and the end of the file. A dropped step gives its action.
        (d4rl(), vec![0..2, 2..4, 4..5], vec![0..2, 2..4, 4..5], vec![1, 2, 4, 0, 6]),
        // The last state of an episode is no step.
        (
            recorded_rows(&[t, t, last, t, last], &[], &[1, 3], false),
            vec![0..2, 2..3],
            vec![0..2, 2..3],
            vec![1, 0, 0],
        ),
        // An episode ends at the goal although the recording goes on.
        (
            recorded_rows(&[t, t, t, d], &[1], &[3], true),
            vec![0..2, 2..3],
            vec![0..2],
            vec![1, 0, 3],
        ),
        // An episode after one that reached its goal is one of the recording.
        (
            recorded_rows(&[t, t, d, t, t, d], &[0], &[2, 5], true),
            vec![0..1, 1..2, 2..4],
            vec![0..1, 2..4],
            vec![0, 2, 4, 5],
        ),
        // Rows with next observations of their own follow one another where these say so.
        (stored, vec![0..2, 2..4], vec![0..2, 2..4], vec![1, 0, 3, 0]),
    ] {
        let transitions = transitions(recording);
        assert_eq!(transitions.episodes(), episodes);
        assert_eq!(transitions.recorded_episodes(), recorded);
        let action = |index| transitions.next_action(index).map_or(0.0, |action| 100.0 * action[0]);
        let actions = (0..transitions.len() as u32).map(|index| action(index).round() as i32);
        assert_eq!(Vec::from_iter(actions), next_actions);
    }
}

/// Rewards and observations are row numbers, actions a hundredth of them.
#[test]
fn windows_of_steps_end_with_their_episode() {
    let transitions = transitions(d4rl());
    let (observations, terminated) = (&[10.0, 11.0, 12.0, 13.0, 14.0], false);
    let (actions, rewards) = (&[0.1, 0.2, 0.3, 0.4], &[1.0, 2.0, 4.0, 8.0]);
    transitions.add_episode(OnlineEpisode { observations, actions, rewards, terminated }).unwrap();
    let window = Window { length: 3, gamma: 0.5, ..Window::ONE };
    let batch = transitions.gather_windows(&[5, 0, 2, 4, 7], window);
    let expected = Batch {
        observations: vec![10.0, 0.0, 3.0, 5.0, 12.0],
        actions: [
            [0.1, 0.2, 0.3],
            [0.0, 0.01, 0.01],
            [0.03, 0.04, 0.04],
            [0.05; 3],
            [0.3, 0.4, 0.4],
        ]
        .concat(),
        rewards: vec![3.0, 0.5, 5.0, 5.0, 8.0],
        next_observations: vec![13.0, 2.0, 5.0, 6.0, 14.0],
        // The third one's episode terminates, the others go on or are truncated.
        masks: vec![0.25, 0.5, 0.0, 1.0, 0.5],
        steps: vec![3, 2, 2, 1, 2],
    };
    assert_eq!(batch, expected);

    let batch = transitions.gather_windows(&[5, 3, 7], Window { history: 3, ..window });
    let seen = [[10.0, 10.0, 10.0], [3.0, 3.0, 4.0], [10.0, 11.0, 12.0]].concat();
    let next = [[11.0, 12.0, 13.0], [3.0, 4.0, 5.0], [12.0, 13.0, 14.0]].concat();
    assert_eq!((batch.observations, batch.next_observations), (seen, next));
    assert_eq!(batch.rewards, [3.0, 4.0, 8.0]);
}

/// As OGBench's data, and as QC's authors cut it: windows from before, in and after a success.
#[test]
fn windows_go_over_a_success_that_does_not_end_the_episode() {
    let mut recording = recording(&[Transition, Transition, Transition, Transition, LastState]);
    (recording.terminals[1], recording.ends[3]) = (true, true);
    let transitions = transitions(recording);
    assert_eq!(transitions.episodes(), [0..2, 2..4]);
    let window = Window { history: 2, length: 3, gamma: 0.5 };
    let batch = transitions.gather_windows(&[0, 1, 2], window);
    let expected = Batch {
        observations: vec![0.0, 0.0, 0.0, 1.0, 1.0, 2.0],
        actions: [[0.0, 0.01, 0.02], [0.01, 0.02, 0.03], [0.02, 0.03, 0.03]].concat(),
        rewards: vec![1.0, 2.75, 3.5],
        next_observations: vec![2.0, 3.0, 3.0, 4.0, 3.0, 4.0],
        masks: vec![0.0, 0.0, 0.5],
        steps: vec![3, 3, 2],
    };
    assert_eq!(batch, expected);
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

#[test]
fn experience_follows_the_dataset_and_is_scaled_as_it_was() {
    let mut recording = d4rl();
    recording.ends[6] = true;
    let reward = RewardRule::Subtract1.scaling(&[]).unwrap();
    let actions = Affine { offset: vec![0.03], scale: vec![0.03] };
    let scaling = Scaling { actions: Some(actions), observations: None, rewards: Some(2.0) };
    let transitions = Transitions::new(recording, None, reward, scaling);
    let episode = |observations, actions, rewards, terminated| {
        transitions.add_episode(OnlineEpisode { observations, actions, rewards, terminated })
    };
    episode(&[10.0, 11.0, 12.0], &[0.045, 0.09], &[3.0, 5.0], false).unwrap();
    // Beyond the range of a dataset's actions.
    episode(&[20.0, 21.0], &[-1.5], &[1.0], true).unwrap();
    assert_eq!((transitions.len(), transitions.experience_len()), (5, 3));
    assert_eq!(transitions.episodes(), [0..2, 2..4, 4..5]);
    assert_eq!(transitions.experience_episodes(), [5..7, 7..8]);
    let limit = 1.0 - 1e-5;
    let batch = transitions.gather(&[7, 1, 6, 5]);
    let expected = Batch {
        observations: vec![20.0, 1.0, 11.0, 10.0],
        actions: vec![-limit, -2.0 / 3.0, limit, 0.5],
        rewards: vec![0.0, 0.0, 2.0, 1.0],
        next_observations: vec![21.0, 2.0, 12.0, 11.0],
        masks: vec![0.0, 1.0, 1.0, 1.0],
        steps: vec![1; 4],
    };
    let apart = batch.actions.iter().zip(&expected.actions).map(|(a, b)| (a - b).abs());
    assert!(apart.fold(0.0, f32::max) < 1e-6, "{batch:?}");
    assert_eq!(batch, Batch { actions: batch.actions.clone(), ..expected });
}

#[test]
fn experience_that_a_dataset_would_be_refused_for_is_refused() {
    let transitions = transitions(d4rl());
    let problem = |observations, actions, rewards| {
        let episode = OnlineEpisode { observations, actions, rewards, terminated: true };
        transitions.add_episode(episode).unwrap_err().to_string()
    };
    for (problem, expected) in [
        (problem(&[0.0], &[], &[]), "0 rows, of which none"),
        (problem(&[0.0], &[0.0], &[0.0]), "`observations` has shape [1], but must have [2]"),
        (problem(&[0.0; 2], &[0.0; 2], &[0.0]), "`actions` has shape [2], but must have [1]"),
        (problem(&[0.0, f32::NAN], &[0.0], &[0.0]), "`observations`, row 1: NaN is not"),
        (problem(&[0.0; 2], &[0.0], &[f32::INFINITY]), "`rewards`, row 0: inf is not"),
    ] {
        assert!(problem.contains(expected), "{problem}");
    }
    assert_eq!(transitions.experience_len(), 0);
}

#[test]
fn an_episode_with_a_number_far_outside_the_dataset_s_range_is_left_out() {
    // Observations and rewards from 0 to 6, actions from 0 to 0.06.
    let mut recording = d4rl();
    recording.names.observations = vec!["elbow".to_owned()];
    let transitions = transitions(recording);
    let add = |observations: &[f32], actions: &[f32], rewards: &[f32]| {
        let episode = OnlineEpisode { observations, actions, rewards, terminated: true };
        transitions.add_episode(episode).unwrap()
    };
    let range = "far outside the dataset's range of";
    for (far, expected) in [
        (
            add(&[0.0, 0.0, 1e30], &[0.0; 2], &[0.0; 2]),
            format!("`observations`, row 2, column 0 (elbow): 1e30, {range} 0 to 6"),
        ),
        (
            add(&[-6001.0, 0.0], &[0.0], &[0.0]),
            format!("`observations`, row 0, column 0 (elbow): -6.001e3, {range} 0 to 6"),
        ),
        (
            add(&[0.0; 2], &[61.0], &[0.0]),
            format!("`actions`, row 0, column 0: 6.1e1, {range} 0 to 0.06"),
        ),
        (
            add(&[0.0; 3], &[0.0; 2], &[0.0, 6007.0]),
            format!("`rewards`, row 1, column 0: 6.007e3, {range} 0 to 6"),
        ),
    ] {
        assert_eq!(far, Some(format!("array {expected}")));
    }
    assert_eq!(transitions.experience_len(), 0);
    assert_eq!(add(&[-5999.0, 6005.0], &[60.0], &[6005.0]), None);
    assert_eq!((transitions.experience_len(), transitions.experience_episodes().len()), (1, 1));
}

#[test]
fn a_column_that_hardly_moved_may_move_online() {
    let mut recording = d4rl();
    for (row, value) in recording.observations.iter_mut().enumerate() {
        *value = 20.0 + 1e-4 * row as f32;
    }
    recording.rewards.fill(0.0);
    let transitions = transitions(recording);
    let is_left_out = |observation: f32, reward: f32| {
        let observations = &[20.0, observation];
        let episode =
            OnlineEpisode { observations, actions: &[0.0], rewards: &[reward], terminated: true };
        transitions.add_episode(episode).unwrap().is_some()
    };
    assert!(!is_left_out(-50.0, 999.0));
    assert!(is_left_out(21_000.0, 0.0) && is_left_out(20.0, -1001.0));
}

/// Nothing is far outside the range of no data.
#[test]
fn without_a_dataset_all_transitions_are_experience() {
    assert!(Transitions::without_data((1, 1), RewardRule::Locomotion).is_err());
    let transitions = Transitions::without_data((1, 1), RewardRule::Subtract1).unwrap();
    let (observations, actions, rewards) = (&[0.0, 1e30, 2.0], &[0.5, -0.5], &[1.0, 0.0]);
    let episode = OnlineEpisode { observations, actions, rewards, terminated: true };
    assert_eq!(transitions.add_episode(episode).unwrap(), None);
    assert_eq!((transitions.len(), transitions.experience_len()), (0, 2));
    let batch = transitions.gather(&[1, 0]);
    assert_eq!((batch.next_observations, batch.rewards), (vec![2.0, 1e30], vec![-1.0, 0.0]));
    assert_eq!(batch.masks, [0.0, 1.0]);
}
