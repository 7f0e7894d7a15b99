//! Practice: what evaluators live through comes back, and makes the same run for any number of
//! them, whatever happens to them.

use std::time::{Duration, Instant};

use quad_run::folder::{read_experience, read_metrics};
use quad_tests::crowd::Crowd;
use quad_tests::learner::Learner;
use quad_tests::made_up::name;
use quad_tests::router::router;
use quad_tests::setting::Setting;
use quad_tests::system::{Scratch, free_endpoint};
use quad_tests::{PATIENCE, eventually};
use tokio::runtime::Runtime;

use crate::crowds::cores;

const SETTING: Setting = Setting {
    steps: 100,
    eval_interval: 250,
    episodes: 2,
    candidates: 2,
    hidden: 16,
    seed: 4,
    online_steps: 0,
};
const ROWS: usize = 600;

fn learner(scratch: &Scratch, run: &str, rows: usize, listen: &str) -> Learner {
    let rows = rows.to_string();
    let arguments = [
        ["--listen", listen],
        ["--online-steps", &rows],
        ["--checkpoint-seconds", "0"],
        ["--set", "online.updates_per_step=2"],
        ["--set", "online.warmup=100"],
        ["--set", "online.lag=3"],
        ["--set", "online.snapshot_interval=50"],
    ];
    scratch.learner_with(run, SETTING, arguments.as_flattened())
}

/// Rows of the recorded episodes, each of which is there once.
fn rows(learner: &Learner) -> usize {
    let records = read_experience(&learner.run_dir).unwrap();
    let mut seeds = Vec::from_iter(records.iter().map(|record| record.episode.score.seed));
    seeds.sort_unstable();
    assert!(seeds.is_sorted_by(|a, b| a < b), "an episode is there twice");
    records.iter().map(|record| record.episode.rewards.len()).sum()
}

#[test]
fn any_number_of_evaluators_makes_the_same_run() {
    let scratch = Scratch::new();
    let runs = [1, 2, 8].map(|count| {
        let mut learner = learner(&scratch, &format!("of-{count}"), ROWS, "tcp/127.0.0.1:0");
        let endpoint = learner.endpoint();
        let name = |i| format!("evaluator-{count}-{i}");
        let _evaluators =
            Vec::from_iter((0..count).map(|i| scratch.evaluator(&name(i), &endpoint)));
        learner.assert_completes(PATIENCE);
        assert!(rows(&learner) >= ROWS);
        learner
    });
    for other in &runs[1..] {
        runs[0].assert_same_as(other);
    }
}

#[test]
fn kills_of_learner_and_evaluators_lose_no_row_and_change_no_bit() {
    const LONG: usize = 5000;
    let scratch = Scratch::new();
    let mut calm = learner(&scratch, "calm", LONG, "tcp/127.0.0.1:0");
    let _evaluator = scratch.evaluator("calm-evaluator", &calm.endpoint());

    let mut faulty = learner(&scratch, "faulty", LONG, "tcp/127.0.0.1:0");
    let endpoint = faulty.endpoint();
    let mut evaluators = ["one", "two"].map(|name| scratch.evaluator(name, &endpoint));
    for kill in 0..5 {
        let before = rows(&faulty);
        eventually("there is new experience", PATIENCE, || (rows(&faulty) > before).then_some(()));
        let evaluator = &mut evaluators[kill % 2];
        evaluator.process.kill();
        *evaluator = scratch.evaluator(&format!("again-{kill}"), &endpoint);
        std::thread::sleep(Duration::from_millis(100));
        faulty.process.kill();
        let kept = rows(&faulty);
        faulty = learner(&scratch, "faulty", LONG, &endpoint);
        faulty.process.wait_for_log("continues after step", PATIENCE);
        assert!(rows(&faulty) >= kept, "what was acknowledged is lost");
    }
    faulty.assert_completes(3 * PATIENCE);
    calm.process.assert_succeeds(3 * PATIENCE);
    faulty.assert_same_as(&calm);
}

/// Prints the environment steps per second that a learner takes in while it trains nothing.
#[test]
#[ignore = "measures"]
fn experience_arrives_as_fast_as_it_is_written() {
    let runtime = Runtime::new().unwrap();
    for count in [1, 8, 64] {
        let (scratch, endpoint) = (Scratch::new(), free_endpoint());
        let arguments = [
            ["--connect", &endpoint],
            ["--online-steps", "100000000"],
            ["--set", "online.warmup=90000000"],
            ["--set", "online.lag=128"],
        ];
        let learner = scratch.learner_with("run", SETTING, arguments.as_flattened());
        let _router = runtime.block_on(router(&endpoint));
        let alone = learner.process.peak_memory().unwrap();
        let run = name("run");
        let crowd = runtime.block_on(Crowd::connect(count, Duration::ZERO, &run, &endpoint));
        let first = learner.wait_for_metric("experience_rows", "", |rows| rows > 10_000.0);
        let begin = Instant::now();
        let last = learner.wait_for_metric("experience_rows", "", |rows| rows > first + 100_000.0);
        let rate = (last - first) / begin.elapsed().as_secs_f64();
        let bytes = (learner.process.peak_memory().unwrap() - alone) as f64 / last;
        eprintln!("{count} evaluators: {rate:.0} steps/s, {bytes:.0} bytes of memory each");
        assert_eq!(crowd.measured().refused, 0);
    }
}

/// Prints how much longer a gradient step of the demonstration's size takes with practice beside it
/// than before it, in each of five runs. The learner trains, receives, checks and writes on one
/// core; time in which it waits for an episode does not count.
#[test]
#[ignore = "measures, on two cores of its own"]
fn practice_slows_no_gradient_step() {
    const STEPS: u64 = 3000;
    let (scratch, launcher) = (Scratch::new(), cores());
    let runtime = Runtime::new().unwrap();
    let setting = Setting { steps: STEPS, eval_interval: 2 * STEPS, hidden: 128, ..SETTING };
    for run in ["run-1", "run-2", "run-3", "run-4", "run-5"] {
        let (endpoint, rows) = (free_endpoint(), STEPS.to_string());
        let arguments = [
            ["--connect", &endpoint],
            ["--online-steps", &rows],
            ["--set", "online.warmup=0"],
            ["--set", "batch_size=256"],
        ];
        let mut learner =
            scratch.learner_through(&launcher, run, setting, arguments.as_flattened());
        let _router = runtime.block_on(router(&endpoint));
        let crowd = Crowd::connect(1, Duration::ZERO, &name(run), &endpoint);
        let _crowd = runtime.block_on(crowd);
        learner.process.assert_succeeds(3 * PATIENCE);
        let lines = read_metrics(&learner.run_dir).unwrap();
        let trained = |step: u64| {
            let line = lines.iter().find(|line| line["step"] == step as f64).unwrap();
            line["seconds"] - line.get("practice_wait_seconds").unwrap_or(&0.0)
        };
        // Without the first steps, in which the machine warms up and the first episode comes.
        let [alone, beside] = [0, STEPS]
            .map(|begin| (trained(begin + STEPS) - trained(begin + 500)) / (STEPS - 500) as f64);
        let (milliseconds, slower) = (1000.0 * alone, 100.0 * (beside / alone - 1.0));
        eprintln!("{milliseconds:.3} ms a step alone, {slower:+.1} % with practice");
    }
}
