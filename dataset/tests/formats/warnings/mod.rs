mod ends;
mod numbers;
mod rows;
mod sound;

use std::path::Path;

use quad_dataset::inspect;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tempfile::tempdir;

use crate::{put, try_read};

const O: usize = 4;

#[derive(Default)]
struct Cart {
    observations: Vec<f32>,
    next_observations: Vec<f32>,
    actions: Vec<f32>,
    rewards: Vec<f32>,
    terminals: Vec<bool>,
    timeouts: Vec<bool>,
}

/// Action, next state, reward, and true if the task is over.
type Step = ([f32; 2], [f32; O], f32, bool);

fn made(
    steps: usize,
    reset: impl Fn(&mut ChaCha8Rng) -> [f32; O],
    step: impl Fn(&mut ChaCha8Rng, [f32; O]) -> Step,
) -> Cart {
    let (mut random, mut cart) = (ChaCha8Rng::seed_from_u64(5), Cart::default());
    for _ in 0..30 {
        let mut state = reset(&mut random);
        for number in 1..=steps {
            let (action, next, reward, terminal) = step(&mut random, state);
            cart.observations.extend(state);
            cart.actions.extend(action);
            cart.next_observations.extend(next);
            cart.rewards.push(reward);
            cart.terminals.push(terminal);
            cart.timeouts.push(!terminal && number == steps);
            state = next;
            if terminal {
                break;
            }
        }
    }
    cart
}

fn mass(steps: usize, seconds: f32) -> Cart {
    let reset = |random: &mut ChaCha8Rng| {
        [random.random_range(-1.0..1.0), random.random_range(-1.0..1.0), 0.0, 0.0]
    };
    made(steps, reset, |random, [x, y, vx, vy]| {
        let noise = [0; 2].map(|_| random.random_range(-0.5_f32..0.5));
        let action =
            [-x - 1.5 * vx + noise[0], -y - 1.5 * vy + noise[1]].map(|push| push.clamp(-1.0, 1.0));
        let next = [
            x + seconds * vx,
            y + seconds * vy,
            vx + seconds * action[0],
            vy + seconds * action[1],
        ];
        let distance = next[0].hypot(next[1]);
        (action, next, -distance, distance < 0.03)
    })
}

impl Cart {
    /// 30 episodes, every third of which terminates; `kept` omits the resets.
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

    fn write(&self, path: &Path, own: bool) {
        let (file, rows) = (hdf5::File::create(path).unwrap(), self.rewards.len());
        if own {
            let layout: hdf5::types::VarLenUnicode = "transitions".parse().unwrap();
            file.new_attr::<hdf5::types::VarLenUnicode>()
                .create("layout")
                .unwrap()
                .write_scalar(&layout)
                .unwrap();
            put(&file, "next_observations", &[rows, O], &self.next_observations);
        }
        put(&file, "observations", &[rows, O], &self.observations);
        put(&file, "actions", &[rows, 2], &self.actions);
        put(&file, "rewards", &[rows], &self.rewards);
        put(&file, "terminals", &[rows], &self.terminals);
        put(&file, "timeouts", &[rows], &self.timeouts);
    }

    fn observe(&mut self, change: impl Fn(&mut [f32])) {
        for values in [&mut self.observations, &mut self.next_observations] {
            values.chunks_exact_mut(O).for_each(&change);
        }
    }

    fn problems(&self, own: bool) -> Vec<String> {
        let folder = tempdir().unwrap();
        let path = folder.path().join("cart.hdf5");
        self.write(&path, own);
        inspect(&path, None).unwrap().problems
    }

    fn warning(&self, own: bool) -> String {
        let warnings = self.warnings(own);
        assert_eq!(warnings.len(), 1, "{warnings:?}");
        warnings[0].clone()
    }

    fn warnings(&self, own: bool) -> Vec<String> {
        let folder = tempdir().unwrap();
        let path = folder.path().join("cart.hdf5");
        self.write(&path, own);
        let inspection = inspect(&path, None).unwrap();
        assert!(!inspection.refused);
        assert_eq!(try_read(&path, None).unwrap().warnings(), inspection.problems);
        inspection.problems
    }
}
