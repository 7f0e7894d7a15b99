use quad_dataset::{environment, inspect};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{assert_sound, cart, empty, mass, record};
use crate::shared;

#[test]
fn a_cart_whose_state_is_kept_or_reset() {
    assert_sound("kept", &cart(true));
    assert_sound("reset", &cart(false));
}

#[test]
fn a_robot_at_a_high_rate() {
    assert_sound("a tenth of a second", &mass(60, 0.1));
    assert_sound("a millisecond", &mass(3000, 0.001));
}

#[test]
fn constant_velocity() {
    let (mut random, mut arrays) = (ChaCha8Rng::seed_from_u64(5), empty());
    let mut draw = || random.random_range(-1.0_f32..1.0);
    for _ in 0..30 {
        let state = [draw(), 0.7, draw(), -0.3];
        record(&mut arrays, 100, state, |[x, vx, y, vy]| {
            let next = [x + 0.01 * vx, vx, y + 0.01 * vy, vy];
            ([draw(), draw()], next, -next[0].abs(), false)
        });
    }
    assert_sound("constant velocity", &arrays);
}

#[test]
fn rewards_at_the_goal_alone() {
    let mut mass = mass(60, 0.1);
    for (goal, others) in [(1.0, 0.0), (0.0, -1.0), (100.0, -1.0)] {
        let rewards = mass.terminals.iter().map(|terminal| if *terminal { goal } else { others });
        mass.rewards = rewards.collect();
        assert_sound("sparse", &mass);
    }
}

#[test]
fn episodes_of_one_step() {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut draw = || random.random_range(-1.0_f32..1.0);
    for stays in [false, true] {
        let mut arrays = empty();
        for _ in 0..600 {
            let (context, next) = ([0; 4].map(|_| draw()), [0; 4].map(|_| draw()));
            record(&mut arrays, 1, context, |state| {
                let action = [draw(), draw()];
                (action, if stays { state } else { next }, action[0] * state[0], true)
            });
        }
        assert_sound("one step", &arrays);
    }
}

#[test]
fn recordings_and_files_of_others() {
    for (file, spec) in [
        ("data/hopper_medium_replay.hdf5", "hopper"),
        ("data/halfcheetah_medium_replay.hdf5", "halfcheetah"),
        ("data/walker2d_medium_replay.hdf5", "walker2d"),
        ("data/antmaze_umaze.hdf5", "antmaze-umaze"),
        ("data/antmaze_umaze_direct.hdf5", "antmaze-umaze"),
        ("data/antmaze_medium_play.hdf5", "antmaze-medium"),
        ("data/antmaze_medium_direct.hdf5", "antmaze-medium"),
        ("fixtures/hopper_fixture-v2.hdf5", "hopper"),
        ("cases/sound.hdf5", ""),
        ("cases/sound-d4rl.hdf5", ""),
        ("cases/half-precision.hdf5", ""),
    ] {
        let Some(path) = shared(file) else { continue };
        for spec in [environment::find(spec).ok(), None] {
            assert_eq!(inspect(&path, spec).unwrap().problems, [""; 0], "{file}");
        }
    }
}
