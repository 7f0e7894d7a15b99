//! Fault upon fault among containers on a private network, and at the end the scores of a run that nothing happened to.
//!
//! QUAD_FAULTS and QUAD_FAULTS_SEED choose how many and which, as for the test `chaos`, which does the same to processes.

use std::collections::BTreeMap;
use std::thread::sleep;
use std::time::{Duration, Instant};

use quad_tests::{eventually, number};
use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::compose::{Compose, LIGHT, PATIENCE, crash, has_ended, succeeds};

const EVALUATORS: usize = 3;
/// Gradient steps for each fault, so that training goes on until the last of them.
const STEPS_PER_FAULT: u64 = 20_000;

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    CrashEvaluator,
    PauseEvaluator,
    CutOffEvaluator,
    RestartRouter,
    PauseRouter,
    CutOffRouter,
    CrashLearner,
    KillLearner,
    PauseLearner,
    CutOffLearner,
}

const FAULTS: [Fault; 10] = [
    Fault::CrashEvaluator,
    Fault::PauseEvaluator,
    Fault::CutOffEvaluator,
    Fault::RestartRouter,
    Fault::PauseRouter,
    Fault::CutOffRouter,
    Fault::CrashLearner,
    Fault::KillLearner,
    Fault::PauseLearner,
    Fault::CutOffLearner,
];

/// A running system, container by container.
struct System {
    compose: Compose,
    learner: String,
    router: String,
    evaluators: Vec<String>,
}

impl System {
    fn inject(&self, fault: Fault, random: &mut ChaCha8Rng) {
        // Zenoh gives up a silent connection after 5 s: some are shorter, some are longer.
        let a_while = Duration::from_millis(random.random_range(100..7000));
        let evaluator = &self.evaluators[random.random_range(0..EVALUATORS)];
        let injected = match fault {
            Fault::CrashEvaluator => crash(evaluator),
            Fault::PauseEvaluator => pause(evaluator, a_while),
            Fault::CutOffEvaluator => self.cut_off("evaluator", evaluator, a_while),
            Fault::RestartRouter => succeeds(&["restart", "--time", "2", &self.router]),
            Fault::PauseRouter => pause(&self.router, a_while),
            Fault::CutOffRouter => self.cut_off("router", &self.router, a_while),
            Fault::CrashLearner => crash(&self.learner),
            Fault::KillLearner => {
                let killed = succeeds(&["kill", &self.learner]);
                self.compose.run(&["up", "--detach", "--no-recreate", "learner"]);
                killed
            }
            Fault::PauseLearner => pause(&self.learner, a_while),
            Fault::CutOffLearner => self.cut_off("learner", &self.learner, a_while),
        };
        // The learner may have reached its end just before.
        assert!(injected || has_ended(&self.learner), "{fault:?} failed");
    }

    /// Takes a container off the network for a while. It comes back with its service's name, and perhaps another address.
    fn cut_off(&self, service: &str, container: &str, a_while: Duration) -> bool {
        let network = self.compose.network();
        succeeds(&["network", "disconnect", &network, container]) && {
            sleep(a_while);
            succeeds(&["network", "connect", "--alias", service, &network, container])
        }
    }
}

fn pause(container: &str, a_while: Duration) -> bool {
    // Where a process of the container cannot be stopped just then, the engine gives up.
    let paused = eventually("the container is paused", PATIENCE, || {
        let paused = succeeds(&["pause", container]);
        (paused || has_ended(container)).then_some(paused)
    });
    paused && {
        sleep(a_while);
        succeeds(&["unpause", container])
    }
}

#[test]
#[ignore = "builds the images: cargo test --release --workspace --test docker -- --ignored"]
fn whatever_happens_to_containers_the_run_ends_as_if_nothing_had() {
    let (count, seed) = (number("QUAD_FAULTS", FAULTS.len() as u64), number("QUAD_FAULTS_SEED", 1));
    let (steps, interval) = (STEPS_PER_FAULT * count, STEPS_PER_FAULT / 2);
    let arguments = format!("{LIGHT} --steps {steps} --eval-interval {interval}");
    let Some(mut compose) = Compose::project("calm", &arguments) else { return };
    let begin = Instant::now();
    let up = ["up", "--detach", "--scale", "evaluator=3", "learner", "evaluator"];
    compose.run(&up);
    compose.assert_run_is_complete("calm", None);
    let calm = begin.elapsed();

    compose.set("QUAD_RUN", "faults");
    compose.run(&up);
    let system = System {
        learner: compose.container("learner"),
        router: compose.container("router"),
        evaluators: compose.containers("evaluator"),
        compose,
    };
    assert_eq!(system.evaluators.len(), EVALUATORS);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut injected, mut faults, mut round) = (0, BTreeMap::new(), Vec::new());
    while injected < count && !has_ended(&system.learner) {
        // Each kind once a round, in another order each time.
        if round.is_empty() {
            round = FAULTS.to_vec();
            round.shuffle(&mut random);
        }
        let fault = round.pop().expect("it was filled");
        system.inject(fault, &mut random);
        *faults.entry(fault).or_insert(0) += 1;
        injected += 1;
        sleep(Duration::from_millis(random.random_range(0..1500)));
    }
    let verdict = system.compose.assert_run_is_complete("faults", Some("calm"));
    eprintln!("{injected} faults in {:.0?}, undisturbed {calm:.0?}: {faults:?}\n{verdict}", begin.elapsed() - calm);
    assert!(injected >= count / 2, "the run was over after {injected} of {count} faults");
}
