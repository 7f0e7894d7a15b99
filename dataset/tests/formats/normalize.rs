use quad_dataset::{
    Arrays, HoldOut, Names, ReadOptions, RewardRule, Split, Transitions, write_own,
};
use quad_kernels::scaling::Affine;

use crate::{assert_close, assert_error, batch, normalize, scratch, steps, write};

fn arrays() -> Arrays {
    let mut arrays = steps(4, 3, 2);
    let o = |a: f32, b: f32| [1e6 + a, b, 0.1];
    let first = [1e6, 7.0, 0.1_f32.next_up()];
    let following = [o(2.0, -1.0), o(3.0, 4.0), o(7.0, 4.0)].concat();
    arrays.observations = [&first[..], &following].concat();
    arrays.next_observations = [&following[..], &[1e6 + 9.0, 0.0, 0.5]].concat();
    arrays.actions = vec![-30.0, 0.25, 10.0, 0.25, 0.0, 0.25, 50.0, 0.25];
    arrays.rewards = vec![1.0, 2.0, 3.0, 4.0];
    arrays.timeouts[3] = true;
    arrays
}

fn affine(offset: &[f32], scale: &[f32]) -> Option<Affine> {
    let (offset, scale) = (offset.to_vec(), scale.to_vec());
    Some(Affine { offset, scale })
}

fn options(columns: &str, reward: RewardRule) -> ReadOptions {
    let normalize = normalize(columns);
    ReadOptions { normalize, reward, ..ReadOptions::default() }
}

/// Reads arrays from a file, with the episodes at `held_out` split off.
fn split(arrays: Arrays, options: ReadOptions, held_out: &[usize]) -> Split {
    let (_folder, path) = scratch("own.hdf5");
    write_own(&path, arrays, Names::default()).unwrap();
    Transitions::read_split(&[&path], &options, HoldOut::Episodes(held_out)).unwrap()
}

fn normalized(arrays: Arrays, columns: &str) -> Transitions {
    split(arrays, options(columns, RewardRule::AsIs), &[]).training
}

/// NumPy's (x - x.mean(0)) / x.std(0) in float64.
#[test]
fn observations_have_mean_0_and_deviation_1() {
    let transitions = normalized(arrays(), "ao");
    let batch = batch(&transitions);
    #[rustfmt::skip]
    let expected = [
        -1.176_696_8, 1.218_543_6, 0.0,
        -0.392_232_27, -1.566_698_9, 0.0,
        0.0, 0.174_077_66, 0.0,
        1.568_929_1, 0.174_077_66, 0.0,
        2.353_393_6, -1.218_543_6, 0.0,
    ];
    assert_close("observations", &batch.observations, &expected[..12]);
    assert_close("next", &batch.next_observations, &expected[3..]);
    // A column that only rounding changes is not seen.
    let (offset, scale) = ([1_000_003.0, 3.5, 0.1], [2.549_509_8, 2.872_281_3, 0.0]);
    assert_eq!(transitions.scaling().observations, affine(&offset, &scale));
}

#[test]
fn rows_that_are_not_learned_from_do_not_count() {
    let (_folder, path) = scratch("d4rl.hdf5");
    let mut arrays = steps(4, 1, 1);
    arrays.observations = vec![0.0, 100.0, 2.0, 77.0];
    arrays.timeouts[1] = true;
    arrays.actions = vec![0.0, -30.0, 10.0, 50.0];
    write(&path, &arrays);
    let options = options("ao", RewardRule::AsIs);
    let transitions = Transitions::read(&path, &options).unwrap();
    let scaling = transitions.scaling();
    assert_eq!(scaling.observations, affine(&[1.0], &[1.0]));
    // Critics see the actions of the timeout and of the last row, as those that follow.
    assert_eq!(scaling.actions, affine(&[10.0], &[40.0]));
    assert_eq!(transitions.next_action(0).unwrap(), [-1.0 + 1e-5]);
}

#[test]
fn actions_reach_from_least_to_largest() {
    let transitions = normalized(arrays(), "a");
    let batch = batch(&transitions);
    // Clipped like actions that are not normalized.
    let expected = [-0.999_99, 0.0, 0.0, 0.0, -0.25, 0.0, 0.999_99, 0.0];
    assert_close("actions", &batch.actions, &expected);
    let scaling = transitions.scaling();
    assert_eq!(scaling.actions, affine(&[10.0, 0.25], &[40.0, 0.0]));
    assert_eq!(scaling.observations, None);
    assert_eq!(batch.observations, arrays().observations);
    assert_eq!(batch.rewards, arrays().rewards);
    assert_eq!(transitions.episodes().len(), 1, "as without scaling");
    assert_eq!(normalized(arrays(), "ao").episodes().len(), 1);
}

#[test]
fn observations_alone_leave_the_range_of_actions_to_be_checked() {
    let (_folder, path) = scratch("own.hdf5");
    write_own(&path, arrays(), Names::default()).unwrap();
    let options = options("o", RewardRule::AsIs);
    let error = Transitions::read(path, &options).err().unwrap();
    let message = "the action -30 is outside [-1, 1] (3 such rows)";
    assert_error(&error, message, "");
}

#[test]
fn rewards_have_a_mean_square_of_1() {
    let transitions = normalized(arrays(), "ar");
    let size = 7.5_f32.sqrt(); // of 1, 2, 3 and 4
    assert_eq!(transitions.scaling().rewards, Some(size));
    let expected = [1.0, 2.0, 3.0, 4.0].map(|reward| reward / size);
    assert_close("rewards", &batch(&transitions).rewards, &expected);
    let recorded = transitions.statistics().return_mean;
    assert_eq!(recorded, 10.0);
    let options = options("ar", RewardRule::CenterTimes4);
    let ruled = split(arrays(), options, &[]).training;
    let expected = [2.0, 6.0, 10.0, 14.0].map(|reward| reward / 84_f32.sqrt());
    assert_close("ruled", &batch(&ruled).rewards, &expected);
    let mut zero = arrays();
    zero.rewards.fill(0.0);
    let zero = normalized(zero, "ar");
    assert_eq!(zero.scaling().rewards, None, "0 has no size");
}

#[test]
fn held_out_episodes_have_the_units_of_training() {
    let mut arrays = arrays();
    arrays.timeouts[1] = true;
    let options = options("ar", RewardRule::AsIs);
    let split = split(arrays, options, &[1]);
    let (training, held_out) = (split.training, split.held_out.unwrap());
    let size = 2.5_f32.sqrt(); // of 1 and 2
    assert_eq!(training.scaling().rewards, Some(size));
    let expected = [3.0, 4.0].map(|reward| reward / size);
    assert_close("held out", &batch(&held_out).rewards, &expected);
    let units = training.standard_units();
    assert_eq!(held_out.standard_units(), units);
    let offset = units.observations.unwrap().offset;
    assert_eq!(offset, [1_000_001.0, 3.0, 0.1]);
}
