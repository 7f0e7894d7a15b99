//! Data that can be trained on, though nothing good would come of it: a cart whose state moves a little at each step and jumps
//! at a reset, with one fault in each file.

use std::path::Path;

use quad_dataset::{ReadOptions, RewardRule, Scale, Transitions, inspect};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tempfile::tempdir;

use crate::{put, try_read};

/// Numbers in an observation.
const O: usize = 4;

/// What a cart did in some episodes, row by row.
#[derive(Default)]
struct Cart {
    observations: Vec<f32>,
    next_observations: Vec<f32>,
    actions: Vec<f32>,
    rewards: Vec<f32>,
    terminals: Vec<bool>,
    timeouts: Vec<bool>,
}

impl Cart {
    /// 30 episodes; every third one terminates, the others are cut off. Where states are `kept`, a new episode begins where the
    /// last one ended.
    fn new(kept: bool) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut draw = |scale: f32| scale * random.random_range(-1.0..1.0);
        let mut cart = Self::default();
        let mut state = [0.0; O];
        for episode in 0..30 {
            if !kept {
                state.fill_with(|| draw(1.0));
            }
            let length = 40 + episode % 7;
            for row in 1..=length {
                let action = [draw(1.0), draw(1.0)];
                cart.observations.extend(state);
                state.iter_mut().for_each(|x| *x = 0.99 * *x + draw(0.02));
                state[0] += 0.02 * action[0];
                cart.next_observations.extend(state);
                cart.actions.extend(action);
                cart.rewards.push(-state[0].abs());
                cart.terminals.push(row == length && episode % 3 == 0);
                cart.timeouts.push(row == length && episode % 3 != 0);
            }
        }
        cart
    }

    /// Writes it in D4RL's layout, or in the custom one.
    fn write(&self, path: &Path, own: bool) {
        let (file, rows) = (hdf5::File::create(path).unwrap(), self.rewards.len());
        if own {
            let layout: hdf5::types::VarLenUnicode = "transitions".parse().unwrap();
            file.new_attr::<hdf5::types::VarLenUnicode>().create("layout").unwrap().write_scalar(&layout).unwrap();
            put(&file, "next_observations", &[rows, O], &self.next_observations);
        }
        put(&file, "observations", &[rows, O], &self.observations);
        put(&file, "actions", &[rows, 2], &self.actions);
        put(&file, "rewards", &[rows], &self.rewards);
        put(&file, "terminals", &[rows], &self.terminals);
        put(&file, "timeouts", &[rows], &self.timeouts);
    }

    /// What is said of it in each layout, by `inspect` and by who trains on it, who both say the same.
    fn doubts(&self, own: bool) -> Vec<String> {
        let folder = tempdir().unwrap();
        let path = folder.path().join("cart.hdf5");
        self.write(&path, own);
        let inspection = inspect(&path, None).unwrap();
        assert!(!inspection.refused);
        assert_eq!(try_read(&path, None).unwrap().doubts(), inspection.problems);
        inspection.problems
    }
}

#[test]
fn of_sound_data_nothing_is_said() {
    for kept in [false, true] {
        for own in [false, true] {
            assert_eq!(Cart::new(kept).doubts(own), [""; 0], "kept: {kept}, own: {own}");
        }
    }
}

#[test]
fn rewards_that_are_all_alike() {
    let mut cart = Cart::new(false);
    cart.rewards.fill(1.0);
    let expected =
        "array `rewards`: all are alike (1), so nothing distinguishes good from bad but how soon an episode terminates";
    assert_eq!(cart.doubts(true), [expected]);
    cart.rewards.fill(0.0);
    assert_eq!(cart.doubts(false), ["array `rewards`: all are alike (0), so nothing distinguishes good from bad"]);
    cart.rewards[70] = 1e-3;
    assert_eq!(cart.doubts(false), [""; 0]);
}

#[test]
fn flags_that_are_a_row_out_of_step_with_the_resets() {
    type Flags = fn(&mut Cart) -> &mut Vec<bool>;
    let (terminals, timeouts): (Flags, Flags) = (|cart| &mut cart.terminals, |cart| &mut cart.timeouts);
    for (flags, name) in [(terminals, "terminals"), (timeouts, "timeouts")] {
        for own in [false, true] {
            let mut cart = Cart::new(false);
            flags(&mut cart).rotate_right(1);
            let [doubt] = &cart.doubts(own)[..] else { panic!("{:?}", cart.doubts(own)) };
            assert!(doubt.starts_with(&format!("{name} are one row late")), "{doubt}");
            flags(&mut cart).rotate_left(2);
            let [doubt] = &cart.doubts(own)[..] else { panic!("{:?}", cart.doubts(own)) };
            assert!(doubt.starts_with(&format!("{name} are one row early")), "{doubt}");
        }
    }
    // Where resets do not show, nothing is known of flags.
    let mut kept = Cart::new(true);
    kept.timeouts.rotate_right(1);
    assert_eq!(kept.doubts(false), [""; 0]);
}

#[test]
fn crashes_are_no_resets() {
    // The step before a termination is as long as a reset.
    let mut cart = Cart::new(false);
    for row in (1..cart.rewards.len()).filter(|&row| cart.terminals[row]) {
        cart.observations[row * O] += 3.0;
    }
    assert_eq!(cart.doubts(false), [""; 0]);
}

#[test]
fn observations_too_large_to_train_on_as_they_are() {
    let mut cart = Cart::new(false);
    for values in [&mut cart.observations, &mut cart.next_observations] {
        values.chunks_exact_mut(O).for_each(|row| (row[1], row[3]) = (1e6 + 1e3 * row[1], 90.0 * row[3]));
    }
    let doubts = cart.doubts(true);
    let [doubt] = &doubts[..] else { panic!("{doubts:?}") };
    assert!(doubt.starts_with("array `observations`: far from ±1 in column 1, of size 999980, which"), "{doubt}");
    assert!(doubt.contains("--scale states"), "{doubt}");
    let folder = tempdir().unwrap();
    let path = folder.path().join("cart.hdf5");
    cart.write(&path, true);
    let scale = Scale { states: true, actions: false };
    let options = ReadOptions { environment: None, task: None, reward: RewardRule::AsIs, scale };
    assert_eq!(Transitions::read(&path, &options).unwrap().doubts(), [""; 0]);
}
