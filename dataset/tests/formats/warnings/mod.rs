mod cases;
mod ends;
mod lengths;
mod numbers;
mod rows;
mod sound;

use std::path::Path;

use quad_dataset::{Arrays, Names, Normalize, ReadOptions, Transitions, inspect, write_own};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{scratch, steps, write};

const O: usize = 4;

type State = [f32; O];

/// Action, next state, reward, and true if the task is over.
type Step = ([f32; 2], State, f32, bool);

fn empty() -> Arrays {
    steps(0, O, 2)
}

/// Appends an episode of at most `length` steps, which starts in `state`.
fn record(
    arrays: &mut Arrays,
    length: usize,
    mut state: State,
    mut step: impl FnMut(State) -> Step,
) {
    for number in 1..=length {
        let (action, next, reward, terminal) = step(state);
        arrays.observations.extend(state);
        arrays.actions.extend(action);
        arrays.next_observations.extend(next);
        arrays.rewards.push(reward);
        arrays.terminals.push(terminal);
        arrays.timeouts.push(!terminal && number == length);
        state = next;
        if terminal {
            break;
        }
    }
}

/// A point mass that is pushed to the origin, at `1 / seconds` steps a second.
fn mass(length: usize, seconds: f32) -> Arrays {
    let (mut random, mut arrays) = (ChaCha8Rng::seed_from_u64(5), empty());
    for _ in 0..30 {
        let [x, y] = [0; 2].map(|_| random.random_range(-1.0..1.0));
        record(&mut arrays, length, [x, y, 0.0, 0.0], |[x, y, vx, vy]| {
            let noise = [0; 2].map(|_| random.random_range(-0.5_f32..0.5));
            let push = [-x - 1.5 * vx + noise[0], -y - 1.5 * vy + noise[1]];
            let action = push.map(|push| push.clamp(-1.0, 1.0));
            let (x, y) = (x + seconds * vx, y + seconds * vy);
            let (vx, vy) = (vx + seconds * action[0], vy + seconds * action[1]);
            (action, [x, y, vx, vy], -x.hypot(y), x.hypot(y) < 0.03)
        });
    }
    arrays
}

/// 30 episodes of a cart, every third of which terminates; `kept` omits the resets.
fn cart(kept: bool) -> Arrays {
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut draw = |scale: f32| scale * random.random_range(-1.0..1.0);
    let (mut arrays, mut state) = (empty(), [0.0; O]);
    for episode in 0..30 {
        if !kept {
            state.fill_with(|| draw(1.0));
        }
        let (length, mut number) = (40 + episode % 7, 0);
        record(&mut arrays, length, state, |mut next| {
            let action = [draw(1.0), draw(1.0)];
            next.iter_mut().for_each(|x| *x = 0.99 * *x + draw(0.02));
            next[0] += 0.02 * action[0];
            (state, number) = (next, number + 1);
            let is_over = number == length && episode % 3 == 0;
            (action, next, -next[0].abs(), is_over)
        });
    }
    arrays
}

/// Cuts the rows, or appends zeros.
fn resize(arrays: &mut Arrays, rows: usize) {
    arrays.observations.resize(rows * O, 0.0);
    arrays.next_observations.resize(rows * O, 0.0);
    arrays.actions.resize(rows * 2, 0.0);
    arrays.rewards.resize(rows, 0.0);
    arrays.terminals.resize(rows, false);
    arrays.timeouts.resize(rows, false);
}

fn observe(arrays: &mut Arrays, change: impl Fn(&mut [f32])) {
    for values in [&mut arrays.observations, &mut arrays.next_observations] {
        values.chunks_exact_mut(O).for_each(&change);
    }
}

fn act(arrays: &mut Arrays, change: impl Fn(&mut [f32])) {
    arrays.actions.chunks_exact_mut(2).for_each(change);
}

/// Writes the custom layout if `own`, else D4RL's.
fn write_as(path: &Path, arrays: &Arrays, own: bool) {
    match own {
        true => write_own(path, arrays.clone(), Names::default()).unwrap(),
        false => drop(write(path, arrays)),
    }
}

fn problems(arrays: &Arrays, own: bool) -> Vec<String> {
    let (_folder, path) = scratch("cart.hdf5");
    write_as(&path, arrays, own);
    inspect(&[&path], None).unwrap().problems
}

/// Problems of data that training accepts, which says the same.
fn warnings(arrays: &Arrays, own: bool) -> Vec<String> {
    let problems = problems(arrays, own);
    let warnings = training_warnings(arrays, own, Normalize::default());
    assert_eq!(warnings, problems);
    problems
}

fn training_warnings(arrays: &Arrays, own: bool, normalize: Normalize) -> Vec<String> {
    let (_folder, path) = scratch("cart.hdf5");
    write_as(&path, arrays, own);
    let options = ReadOptions { normalize, ..ReadOptions::default() };
    let transitions = Transitions::read(&path, &options).unwrap();
    without_name(transitions.warnings(), &path)
}

/// Warnings without the file's name before each.
pub(super) fn without_name(warnings: &[String], path: &Path) -> Vec<String> {
    let name = format!("{}: ", path.display());
    warnings.iter().map(|warning| warning.replacen(&name, "", 1)).collect()
}

/// Checks the start of the only warning, and a part of it.
pub(super) fn assert_one(warnings: &[String], start: &str, part: &str) {
    let [warning] = warnings else { panic!("{warnings:?}") };
    assert!(warning.starts_with(start), "{warning}, not {start}");
    assert!(warning.contains(part), "{warning}, not {part}");
}

fn assert_warned(arrays: &Arrays, own: bool, start: &str, part: &str) {
    assert_one(&warnings(arrays, own), start, part);
}

fn assert_sound(name: &str, arrays: &Arrays) {
    for own in [false, true] {
        assert_eq!(warnings(arrays, own), [""; 0], "{name}, own: {own}");
    }
}
