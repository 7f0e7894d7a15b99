//! Fault upon fault at random moments, and at the end a run that is, bit for bit, the one that
//! nothing happened to.
//!
//! QUAD_FAULTS says how many faults there are in the long test, and QUAD_FAULTS_SEED chooses
//! others.

use std::thread::sleep;
use std::time::{Duration, Instant};

use quad_tests::link::Trouble;
use quad_tests::setting::{SHORT, Setting};
use quad_tests::system::Scratch;
use quad_tests::{PATIENCE, eventually, number};
use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::system::{Fault, Program, System, all_faults};

/// Gradient steps for each fault, so that training continues until the last of them.
const STEPS_PER_FAULT: u64 = 12_000;

/// Lets so many faults of those kinds happen, in a run with these online environment steps or
/// without.
fn endure(faults: &[Fault], count: u64, online_steps: u64) {
    let steps = if online_steps > 0 { 1000 } else { STEPS_PER_FAULT * count };
    let sizes = Setting { episodes: 4, candidates: 20, hidden: 64, ..SHORT };
    let setting = Setting { steps, eval_interval: STEPS_PER_FAULT / 2, online_steps, ..sizes };
    let begin = Instant::now();
    let scratch = Scratch::new();
    let mut calm = scratch.learner("calm", setting);
    let _evaluator = scratch.evaluator("calm-evaluator", &calm.endpoint());

    let mut system = System::start(setting);
    let mut random = ChaCha8Rng::seed_from_u64(number("QUAD_FAULTS_SEED", 1));
    let (mut injected, mut round) = (0, Vec::new());
    while injected < count && !system.is_over() {
        sleep(Duration::from_millis(random.random_range(0..1500)));
        // Each kind once a round, in another order each time.
        if round.is_empty() {
            round = faults.to_vec();
            round.shuffle(&mut random);
        }
        system.inject(round.pop().expect("it was filled"), &mut random);
        injected += 1;
    }
    let patience = 2 * PATIENCE + begin.elapsed();
    eventually("the run is over", patience, || system.is_over().then_some(()));
    system.learner.assert_complete();
    calm.process.assert_succeeds(patience);
    let found = system.learner.assert_same_as(&calm);
    eprintln!("{injected} faults in {:.0?}: {:?}\n{found}", begin.elapsed(), system.faults);
    assert!(injected >= count / 2, "the run was over after {injected} of {count} faults");
}

#[test]
fn a_few_faults_change_no_bit_of_a_run() {
    let faults = [
        Fault::Kill(Program::Evaluator),
        Fault::Kill(Program::Learner),
        Fault::Link(Program::Evaluator, Trouble::Cut),
        Fault::Link(Program::Learner, Trouble::Silent),
        Fault::RestartRouter,
        Fault::FillDisk,
        Fault::DeliverAgain,
    ];
    endure(&faults, faults.len() as u64, 0);
}

/// Five kills of each program, a cut link and a full disk.
#[test]
fn a_few_faults_lose_no_row_of_experience_and_change_no_bit() {
    let kills = [Program::Learner, Program::Evaluator].map(Fault::Kill).repeat(5);
    let others = [Fault::Link(Program::Evaluator, Trouble::Cut), Fault::FillDisk];
    let faults = [&kills[..], &others].concat();
    endure(&faults, faults.len() as u64, 30_000);
}

#[test]
#[ignore = "ten minutes"]
fn a_hundred_faults_change_no_bit_of_a_run() {
    endure(&all_faults(), number("QUAD_FAULTS", 100), 0);
}
