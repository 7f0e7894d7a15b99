use std::path::PathBuf;

use quad_dataset::{
    Arrays, Batch, HoldOut, Names, Normalize, ReadOptions, RewardRule, Transitions, write_own,
};
use tempfile::{TempDir, tempdir};

use crate::{all, assert_close, put};

fn arrays() -> Arrays {
    let o = |a: f32, b: f32, c: f32| [1e6 + a, b, c];
    Arrays {
        observation_dim: 3,
        action_dim: 2,
        observations: [o(0.0, 7.0, 0.1), o(2.0, -1.0, 0.1), o(3.0, 4.0, 0.1), o(7.0, 4.0, 0.1)]
            .concat(),
        actions: vec![-30.0, 0.25, 10.0, 0.25, 0.0, 0.25, 50.0, 0.25],
        rewards: vec![1.0, 2.0, 3.0, 4.0],
        next_observations: [
            o(2.0, -1.0, 0.1),
            o(3.0, 4.0, 0.1),
            o(7.0, 4.0, 0.1),
            o(9.0, 0.0, 0.5),
        ]
        .concat(),
        terminals: vec![false; 4],
        timeouts: vec![false, false, false, true],
    }
}

fn file() -> (TempDir, PathBuf) {
    let folder = tempdir().unwrap();
    let path = folder.path().join("own.hdf5");
    write_own(&path, arrays(), Names::default()).unwrap();
    (folder, path)
}

fn options(normalize: Normalize) -> ReadOptions {
    ReadOptions { normalize, ..ReadOptions::default() }
}

fn normalized(actions: bool, observations: bool) -> Transitions {
    Transitions::read(file().1, &options(Normalize { actions, observations, rewards: false }))
        .unwrap()
}

/// NumPy's (x - x.mean(0)) / x.std(0) in float64.
#[test]
fn observations_have_mean_0_and_deviation_1() {
    let transitions = normalized(true, true);
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
    assert_eq!(
        affine.scale,
        [2.549_509_8, 2.872_281_3, 0.0],
        "a column that never changes is not seen"
    );
}

#[test]
fn rows_that_are_not_learned_from_do_not_count() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("d4rl.hdf5");
    let file = hdf5::File::create(&path).unwrap();
    put(&file, "observations", &[4, 1], &[0.0f32, 100.0, 2.0, 77.0]);
    put(&file, "actions", &[4, 1], &[0.5f32; 4]);
    put(&file, "rewards", &[4], &[1.0f32, 2.0, 3.0, 4.0]);
    put(&file, "terminals", &[4], &[false; 4]);
    put(&file, "timeouts", &[4], &[false, true, false, false]);
    drop(file);
    let normalize = Normalize { observations: true, ..Normalize::default() };
    let options = ReadOptions { normalize, ..ReadOptions::default() };
    let affine =
        Transitions::read(&path, &options).unwrap().scaling().observations.clone().unwrap();
    assert_eq!((affine.offset, affine.scale), (vec![1.0], vec![1.0]));
}

#[test]
fn actions_reach_from_least_to_largest() {
    let transitions = normalized(true, false);
    let batch = all(&transitions);
    // Clipped like actions that are not normalized.
    assert_close("actions", &batch.actions, &[-0.999_99, 0.0, 0.0, 0.0, -0.25, 0.0, 0.999_99, 0.0]);
    let scaling = transitions.scaling();
    let affine = scaling.actions.clone().unwrap();
    assert_eq!((affine.offset, affine.scale), (vec![10.0, 0.25], vec![40.0, 0.0]));
    assert_eq!(
        (batch.observations, &scaling.observations),
        (arrays().observations, &None),
        "as they are"
    );
    assert_eq!(batch.rewards, arrays().rewards);
    assert_eq!(transitions.episodes().len(), 1, "as without scaling");
    assert_eq!(normalized(true, true).episodes(), transitions.episodes());
}

#[test]
fn observations_alone_leave_the_range_of_actions_to_be_checked() {
    let (_folder, path) = file();
    let error =
        Transitions::read(path, &options(Normalize { observations: true, ..Normalize::default() }))
            .err()
            .unwrap();
    assert!(error.to_string().contains("the action -30 is outside [-1, 1]"), "{error}");
}

#[test]
fn rewards_have_a_mean_square_of_1() {
    let (_folder, path) = file();
    let normalize = Normalize { actions: true, observations: false, rewards: true };
    let transitions = Transitions::read(&path, &options(normalize)).unwrap();
    let size = 7.5_f32.sqrt(); // of 1, 2, 3 and 4
    assert_eq!(transitions.scaling().rewards, Some(size));
    assert_close(
        "rewards",
        &all(&transitions).rewards,
        &[1.0, 2.0, 3.0, 4.0].map(|reward| reward / size),
    );
    assert_eq!(transitions.statistics().return_mean, 10.0, "as they were recorded");
    let rule = ReadOptions { reward: RewardRule::CenterTimes4, ..options(normalize) };
    let ruled = Transitions::read(&path, &rule).unwrap();
    assert_close(
        "ruled",
        &all(&ruled).rewards,
        &[2.0, 6.0, 10.0, 14.0].map(|reward| reward / 84_f32.sqrt()),
    );
    write_own(&path, Arrays { rewards: vec![0.0; 4], ..arrays() }, Names::default()).unwrap();
    assert_eq!(
        Transitions::read(&path, &options(normalize)).unwrap().scaling().rewards,
        None,
        "0 has no size"
    );
    let whole = Arrays { timeouts: vec![false, true, false, true], ..arrays() };
    write_own(&path, whole, Names::default()).unwrap();
    let split =
        Transitions::read_split(&path, &options(normalize), HoldOut::Episodes(&[1])).unwrap();
    let size = 2.5_f32.sqrt(); // of 1 and 2
    assert_eq!(split.training.scaling().rewards, Some(size));
    assert_close("held out", &all(&split.held_out.unwrap()).rewards, &[3.0 / size, 4.0 / size]);
}
