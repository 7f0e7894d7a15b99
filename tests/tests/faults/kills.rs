//! A learner that is killed again and again ends with the weights and scores of one left alone.

use std::thread::sleep;
use std::time::{Duration, Instant};

use quad_tests::PATIENCE;
use quad_tests::setting::Setting;
use quad_tests::system::{Scratch, free_endpoint};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Gradient steps for each incarnation.
const STEPS_PER_LIFE: u64 = 3000;

/// Kills a learner so often, each time at a random moment.
fn endure(kills: u64) {
    let steps = STEPS_PER_LIFE * kills;
    let setting = Setting { steps, eval_interval: steps / 10, episodes: 4, candidates: 2, hidden: 64, seed: 5 };
    let scratch = Scratch::new();
    let mut calm = scratch.learner("calm", setting);
    let _calm_evaluator = scratch.evaluator("calm-evaluator", &calm.endpoint());

    let endpoint = free_endpoint();
    let _evaluator = scratch.evaluator("loyal", &endpoint);
    let mut moments = ChaCha8Rng::seed_from_u64(1);
    let arguments = ["--listen", &endpoint, "--checkpoint-seconds", "0"];
    let mut start = Duration::MAX;
    for life in 0..kills {
        let begin = Instant::now();
        let mut learner = scratch.learner_with("run", setting, &arguments);
        // The moments go by what this machine has done, not by the clock: it may be a fast or a slow one. Every other one
        // is while the learner trains, the others are while it starts, or soon after.
        if life % 2 == 0 {
            learner.process.wait_for_log("run run is at", PATIENCE);
            start = start.min(begin.elapsed());
            let step = 2000 * life + moments.random_range(1..4000);
            learner.wait_for_metric("gradient_steps_total", "", |steps| steps >= step as f64);
        } else {
            sleep(start.mul_f64(moments.random_range(0.0..2.0)));
        }
        learner.process.kill();
        assert!(!learner.process.log().contains("training is done"), "training was over too soon");
        learner.assert_scores_are_distinct();
    }
    let mut learner = scratch.learner_with("run", setting, &arguments);
    learner.assert_completes(&setting, PATIENCE);
    calm.assert_completes(&setting, PATIENCE);
    learner.assert_same_as(&calm);

    // A run that is complete is so at once.
    let mut again = scratch.learner_with("run", setting, &arguments);
    again.process.assert_succeeds(PATIENCE);
    assert!(again.process.out().contains("mean score of the last 3 evaluations"), "{}", again.process.out());
    again.assert_same_as(&calm);
}

#[test]
fn three_kills_change_no_bit_of_a_run() {
    endure(3);
}

#[test]
#[ignore = "a minute"]
fn ten_kills_change_no_bit_of_a_run() {
    endure(10);
}
