//! Programs that are killed and a router that dies change no bit of a run.

use quad_tests::router::Router;
use quad_tests::setting::Setting;
use quad_tests::system::Scratch;
use quad_tests::wait_until;

/// Ten thousand rows of experience, with two gradient steps each.
const SETTING: Setting = Setting {
    steps: 1000,
    eval_interval: 2000,
    episodes: 4,
    candidates: 20,
    hidden: 64,
    online_steps: 10_000,
};
const STEPS: u64 = SETTING.steps + 2 * SETTING.online_steps;
const FAULTS: u64 = 12;

#[tokio::test(flavor = "multi_thread")]
async fn kills_and_a_routers_death_change_no_bit_of_a_run() {
    let scratch = Scratch::new();
    let mut calm = scratch.learner("calm", SETTING);
    let _evaluator = scratch.evaluator("calm-evaluator", &calm.endpoint());

    let mut router = Router::later();
    router.start().await;
    let endpoint = router.endpoint.clone();
    let connect = ["--connect", &endpoint, "--checkpoint-seconds", "0"];
    let start_learner = || scratch.learner_with("run", SETTING, &connect);
    let start_evaluator = |number| scratch.evaluator(&format!("evaluator-{number}"), &endpoint);
    let mut learner = start_learner();
    let mut evaluators = Vec::from_iter((0..3).map(start_evaluator));
    for fault in 1..=FAULTS {
        let step = (STEPS * fault / (FAULTS + 1)) as f64;
        wait_until("training goes on", || {
            let steps = learner.metric("gradient_steps_total", "");
            steps.is_some_and(|steps| steps >= step) || !learner.process.is_running()
        });
        match fault % 3 {
            0 => {
                router.end().await;
                router.start().await;
            }
            1 => {
                learner.process.kill();
                learner = start_learner();
            }
            _ => {
                evaluators.remove(0).kill();
                evaluators.push(start_evaluator(2 + fault));
            }
        }
    }
    learner.assert_completes();
    calm.assert_completes();
    learner.assert_same_as(&calm);
}
