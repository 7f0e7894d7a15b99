use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{assert_sound, cart, empty, mass, record};

#[test]
fn a_cart_whose_state_is_kept_or_reset_and_a_robot_at_a_low_or_high_rate() {
    assert_sound("kept", &cart(true));
    assert_sound("reset", &cart(false));
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
    for (goal, step) in [(1.0, 0.0), (0.0, -1.0), (100.0, -1.0)] {
        let reward = |terminal: &bool| if *terminal { goal } else { step };
        let rewards = mass.terminals.iter().map(reward);
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
                let next = if stays { state } else { next };
                (action, next, action[0] * state[0], true)
            });
        }
        assert_sound("one step", &arrays);
    }
}
