use quad_dataset::{
    Arrays, Batch, HoldOut, Names, Normalize, ReadOptions, RewardRule, Split, Transitions,
    write_own,
};

use crate::{all, assert_close, assert_error, scratch, steps, write};

fn arrays() -> Arrays {
    let o = |a: f32, b: f32, c: f32| [1e6 + a, b, c];
    let (first, second, third) =
        (o(0.0, 7.0, 0.1_f32.next_up()), o(2.0, -1.0, 0.1), o(3.0, 4.0, 0.1));
    let (fourth, last) = (o(7.0, 4.0, 0.1), o(9.0, 0.0, 0.5));
    Arrays {
        observation_dim: 3,
        action_dim: 2,
        observations: [first, second, third, fourth].concat(),
        actions: vec![-30.0, 0.25, 10.0, 0.25, 0.0, 0.25, 50.0, 0.25],
        rewards: vec![1.0, 2.0, 3.0, 4.0],
        next_observations: [second, third, fourth, last].concat(),
        terminals: vec![false; 4],
        timeouts: vec![false, false, false, true],
    }
}

const ACTIONS: Normalize = Normalize { actions: true, observations: false, rewards: false };
const BOTH: Normalize = Normalize { observations: true, ..ACTIONS };
const REWARDS: Normalize = Normalize { rewards: true, ..ACTIONS };

/// Reads arrays from a file, with the episodes at `held_out` split off.
fn split(arrays: Arrays, normalize: Normalize, reward: RewardRule, held_out: &[usize]) -> Split {
    let (_folder, path) = scratch("own.hdf5");
    write_own(&path, arrays, Names::default()).unwrap();
    let options = ReadOptions { normalize, reward, ..ReadOptions::default() };
    Transitions::read_split(&path, &options, HoldOut::Episodes(held_out)).unwrap()
}

fn normalized(arrays: Arrays, normalize: Normalize) -> Transitions {
    split(arrays, normalize, RewardRule::AsIs, &[]).training
}

/// NumPy's (x - x.mean(0)) / x.std(0) in float64.
#[test]
fn observations_have_mean_0_and_deviation_1() {
    let transitions = normalized(arrays(), BOTH);
    let Batch { observations, next_observations, .. } = all(&transitions);
    #[rustfmt::skip]
    let expected = [
        -1.176_696_8, 1.218_543_6, 0.0,
        -0.392_232_27, -1.566_698_9, 0.0,
        0.0, 0.174_077_66, 0.0,
        1.568_929_1, 0.174_077_66, 0.0,
        2.353_393_6, -1.218_543_6, 0.0,
    ];
    assert_close("observations", &observations, &expected[..12]);
    assert_close("next observations", &next_observations, &expected[3..]);
    let affine = transitions.scaling().observations.clone().unwrap();
    assert_eq!(affine.offset, [1_000_003.0, 3.5, 0.1]);
    // A column that only rounding changes is not seen.
    assert_eq!(affine.scale, [2.549_509_8, 2.872_281_3, 0.0]);
}

#[test]
fn rows_that_are_not_learned_from_do_not_count() {
    let (_folder, path) = scratch("d4rl.hdf5");
    let mut arrays = steps(4, 1, 1);
    arrays.observations = vec![0.0, 100.0, 2.0, 77.0];
    arrays.timeouts[1] = true;
    arrays.actions = vec![0.0, -30.0, 10.0, 50.0];
    write(&path, &arrays);
    let options = ReadOptions { normalize: BOTH, ..ReadOptions::default() };
    let transitions = Transitions::read(&path, &options).unwrap();
    let affine = transitions.scaling().observations.clone().unwrap();
    assert_eq!((affine.offset, affine.scale), (vec![1.0], vec![1.0]));
    // Critics see the actions of the timeout and of the last row, as those that follow.
    let affine = transitions.scaling().actions.clone().unwrap();
    assert_eq!((affine.offset, affine.scale), (vec![10.0], vec![40.0]));
    assert_eq!(transitions.next_action(0).unwrap(), [-1.0 + 1e-5]);
}

#[test]
fn actions_reach_from_least_to_largest() {
    let transitions = normalized(arrays(), ACTIONS);
    let batch = all(&transitions);
    // Clipped like actions that are not normalized.
    assert_close("actions", &batch.actions, &[-0.999_99, 0.0, 0.0, 0.0, -0.25, 0.0, 0.999_99, 0.0]);
    let scaling = transitions.scaling();
    let affine = scaling.actions.clone().unwrap();
    assert_eq!((affine.offset, affine.scale), (vec![10.0, 0.25], vec![40.0, 0.0]));
    assert_eq!(scaling.observations, None);
    assert_eq!((batch.observations, batch.rewards), (arrays().observations, arrays().rewards));
    assert_eq!(transitions.episodes().len(), 1, "as without scaling");
    assert_eq!(normalized(arrays(), BOTH).episodes(), transitions.episodes());
}

#[test]
fn observations_alone_leave_the_range_of_actions_to_be_checked() {
    let (_folder, path) = scratch("own.hdf5");
    write_own(&path, arrays(), Names::default()).unwrap();
    let normalize = Normalize { observations: true, ..Normalize::default() };
    let options = ReadOptions { normalize, ..ReadOptions::default() };
    let error = Transitions::read(path, &options).err().unwrap();
    assert_error(&error, "the action -30 is outside [-1, 1] (3 such rows)", "");
}

#[test]
fn rewards_have_a_mean_square_of_1() {
    let transitions = normalized(arrays(), REWARDS);
    let size = 7.5_f32.sqrt(); // of 1, 2, 3 and 4
    assert_eq!(transitions.scaling().rewards, Some(size));
    let expected = [1.0, 2.0, 3.0, 4.0].map(|reward| reward / size);
    assert_close("rewards", &all(&transitions).rewards, &expected);
    assert_eq!(transitions.statistics().return_mean, 10.0, "as they were recorded");
    let ruled = split(arrays(), REWARDS, RewardRule::CenterTimes4, &[]).training;
    let expected = [2.0, 6.0, 10.0, 14.0].map(|reward| reward / 84_f32.sqrt());
    assert_close("ruled", &all(&ruled).rewards, &expected);
    let zero = normalized(Arrays { rewards: vec![0.0; 4], ..arrays() }, REWARDS);
    assert_eq!(zero.scaling().rewards, None, "0 has no size");
    let two = Arrays { timeouts: vec![false, true, false, true], ..arrays() };
    let Split { training, held_out, .. } = split(two, REWARDS, RewardRule::AsIs, &[1]);
    let size = 2.5_f32.sqrt(); // of 1 and 2
    assert_eq!(training.scaling().rewards, Some(size));
    assert_close("held out", &all(&held_out.unwrap()).rewards, &[3.0 / size, 4.0 / size]);
}

#[test]
fn standard_units_of_held_out_episodes_are_those_of_training() {
    let two = Arrays { timeouts: vec![false, true, false, true], ..arrays() };
    let Split { training, held_out, .. } = split(two, ACTIONS, RewardRule::AsIs, &[1]);
    let units = training.standard_units();
    assert_eq!(units.observations.clone().unwrap().offset, [1_000_001.0, 3.0, 0.1]);
    assert_eq!(held_out.unwrap().standard_units(), units);
}
