//! A learner that is killed, stopped or short of disk goes on where it was: the same weights and the same scores.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::thread::sleep;
use std::time::{Duration, Instant};

use quad_protocol::Hash;
use quad_tests::system::{Learner, Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A few seconds of training with evaluations all along.
const LONG: Setting = Setting { steps: 3000, eval_interval: 300, episodes: 4, candidates: 2, hidden: 64, seed: 5 };
/// More of it than ten lives need.
const LONGER: Setting = Setting { steps: 30_000, eval_interval: 3000, ..LONG };
const CHECKPOINTS: [&str; 2] = ["--checkpoint-seconds", "0"];

/// The scores of a run, whoever measured them: (step, seed) to (weights, return as bits).
fn scores(learner: &Learner) -> BTreeMap<(u64, u64), (String, u64)> {
    let scores = learner.scores();
    let count = scores.len();
    let by_key: BTreeMap<_, _> = scores
        .iter()
        .map(|score| (score.key(), (score.text("weights").to_owned(), score.number("return").to_bits())))
        .collect();
    assert_eq!(by_key.len(), count, "a (step, seed) has two scores");
    by_key
}

/// The files of a folder, name by name.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap());
    entries.map(|entry| (entry.file_name().into_string().unwrap(), fs::read(entry.path()).unwrap())).collect()
}

/// A run that nothing happens to.
fn undisturbed(scratch: &Scratch) -> Learner {
    let mut learner = scratch.learner("undisturbed", LONGER);
    let _evaluator = scratch.evaluator("calm", &learner.endpoint());
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&LONGER);
    learner
}

/// That the last snapshot, the last checkpoint and all scores are those of another run of the same seed.
fn assert_same(learner: &Learner, other: &Learner) {
    learner.assert_complete(&LONGER);
    assert!(files(&learner.run_dir.join("snapshots")) == files(&other.run_dir.join("snapshots")), "snapshots differ");
    let last = |learner: &Learner| files(&learner.run_dir.join("checkpoints")).pop_last().unwrap();
    assert!(last(learner) == last(other), "the last checkpoints differ");
    assert_eq!(scores(learner), scores(other));
}

#[test]
fn a_learner_killed_at_any_moment_ends_with_the_weights_and_scores_of_one_left_alone() {
    let scratch = Scratch::new();
    let calm = undisturbed(&scratch);
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let _evaluator = scratch.evaluator("loyal", &endpoint);
    let mut moments = ChaCha8Rng::seed_from_u64(1);
    let arguments = [&["--listen", &endpoint][..], &CHECKPOINTS].concat();
    let (mut start, mut training) = (Duration::MAX, 0);
    for life in 0..10 {
        let begin = Instant::now();
        let mut learner = scratch.learner_with("run", LONGER, &arguments);
        // The moments go by what this machine has done, not by the clock: it may be a fast or a slow one. Every other one
        // is while the learner trains, the others are while it starts, or soon after.
        if life % 2 == 0 {
            learner.process.wait_for_log("run run is at", PATIENCE);
            start = start.min(begin.elapsed());
            let step = 2000 * life + moments.random_range(1..4000);
            eventually("it trains", PATIENCE, || {
                let page = http::metrics(&learner.metrics())?;
                (http::sum(&page, "quad_learner_gradient_steps_total", "") >= step as f64).then_some(())
            });
        } else {
            sleep(start.mul_f64(moments.random_range(0.0..2.0)));
        }
        learner.process.kill();
        training += usize::from(!learner.process.log().contains("training is done"));
        scores(&learner);
    }
    assert_eq!(training, 10, "training was over too soon");
    let mut learner = scratch.learner_with("run", LONGER, &arguments);
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    assert_same(&learner, &calm);

    // A run that is complete is so at once.
    let mut again = scratch.learner_with("run", LONGER, &arguments);
    assert!(again.process.wait(PATIENCE).success());
    assert!(again.process.out().contains("mean score of the last 3 evaluations"), "{}", again.process.out());
    assert_same(&again, &calm);
}

#[test]
fn a_stopped_learner_goes_on_from_its_very_step() {
    let scratch = Scratch::new();
    let setting = Setting { steps: 100_000_000, ..LONG };
    let learner = |arguments: &[&str]| {
        scratch.learner_with("run", setting, &[&["--listen", "tcp/127.0.0.1:0"], arguments].concat())
    };
    let step_of = |learner: &Learner| -> u64 {
        let line = learner.process.wait_for_log("goes on after step", PATIENCE);
        let step = line.split("goes on after step ").nth(1).unwrap().split(';').next().unwrap();
        step.parse().unwrap()
    };
    let mut first = learner(&[]);
    first.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
    let (duration, status) = first.process.terminate(PATIENCE);
    assert_eq!(status.code(), Some(1));
    assert!(duration < Duration::from_secs(10), "it took {duration:?} to leave");
    assert!(first.process.log().contains("the same command goes on from there"), "{}", first.process.log());

    let mut second = learner(&[]);
    let step = step_of(&second);
    assert!(step >= 300, "{step}");
    // A damaged checkpoint falls back to the one before, here to the very beginning.
    second.process.kill();
    let (name, mut bytes) = files(&second.run_dir.join("checkpoints")).pop_last().unwrap();
    bytes.truncate(bytes.len() / 2);
    fs::write(second.run_dir.join("checkpoints").join(name), bytes).unwrap();
    let mut third = learner(&[]);
    assert!(step_of(&third) < step);
    assert!(third.process.log().contains("is damaged"), "{}", third.process.log());
    third.process.terminate(PATIENCE);

    // Another configuration is refused with what differs, and changes nothing; begun anew, the old one is kept.
    let mut other = learner(&["--seed", "6"]);
    assert_eq!(other.process.wait(PATIENCE).code(), Some(1));
    let log = other.process.log();
    assert!(log.contains("seed: 5 there, 6 here") && log.contains("--fresh"), "{log}");
    let fresh = learner(&["--seed", "6", "--fresh"]);
    fresh.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
    assert!(scratch.path().join("run.old1/config.toml").exists());
    assert!(!fresh.process.log().contains("goes on after step"));

    // While it is at work, nobody else may be.
    let mut twin = learner(&["--seed", "6"]);
    assert_eq!(twin.process.wait(PATIENCE).code(), Some(1));
    assert!(twin.process.log().contains("another learner is at work"), "{}", twin.process.log());
}

/// As if the scores were of another machine's bits. Training has to come by the step again to find out.
#[test]
fn weights_that_come_out_otherwise_for_a_scored_step_end_the_run() {
    for snapshot_is_there in [true, false] {
        let scratch = Scratch::new();
        let mut learner = scratch.learner("run", LONG);
        let _evaluator = scratch.evaluator("one", &learner.endpoint());
        eventually("there are scores", PATIENCE, || (!learner.scores().is_empty()).then_some(()));
        learner.process.kill();
        fs::remove_dir_all(learner.run_dir.join("checkpoints")).ok();
        let first = learner.scores().remove(0);
        let snapshot = learner.snapshot(first.key().0);
        let mut bytes = fs::read(&snapshot).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        if snapshot_is_there {
            fs::write(&snapshot, &bytes).unwrap();
        }
        let log = learner.run_dir.join("scores.jsonl");
        let weights = Hash::of(&bytes).to_string();
        fs::write(&log, fs::read_to_string(&log).unwrap().replace(first.text("weights"), &weights)).unwrap();
        let mut learner = scratch.learner("run", LONG);
        assert_eq!(learner.process.wait(PATIENCE).code(), Some(1));
        let said = learner.process.log();
        assert!(said.contains(&format!("but {weights} were scored before")), "{said}");
        assert!(said.contains("hint: another kind of processor"), "{said}");
        if snapshot_is_there {
            assert!(fs::read(&snapshot).unwrap() == bytes, "what was scored is overwritten");
        }
    }
}

#[test]
fn a_damaged_snapshot_holds_up_nothing_and_what_has_no_score_is_an_error_at_the_end() {
    let scratch = Scratch::new();
    let setting = Setting::default();
    let mut learner = scratch.learner("run", setting);
    let endpoint = learner.endpoint();
    let _evaluator = scratch.evaluator("one", &endpoint);
    assert!(learner.process.wait(PATIENCE).success());
    let [first, second, ..] = setting.evaluated_steps()[..] else { panic!("two evaluations") };
    let damage = |learner: &Learner, step| {
        let mut bytes = fs::read(learner.snapshot(step)).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        fs::write(learner.snapshot(step), bytes).unwrap();
    };
    damage(&learner, first);
    let leftover = learner.run_dir.join("checkpoints/step_000000001_0123456789abcdef.safetensors.partial");
    fs::write(&leftover, "half").unwrap();
    let mut learner = scratch.learner_with("run", setting, &["--listen", &endpoint]);
    assert!(learner.process.wait(PATIENCE).success(), "it has all its scores");
    assert!(learner.process.log().contains("its file is damaged"), "{}", learner.process.log());
    assert!(!leftover.exists());

    // One that has not all of them cannot get the rest.
    damage(&learner, second);
    let log = learner.run_dir.join("scores.jsonl");
    let lines = fs::read_to_string(&log).unwrap();
    let lost = lines.lines().position(|line| line.contains(&format!("\"step\":{second},"))).unwrap();
    let kept = lines.lines().enumerate().filter(|(number, _)| *number != lost).map(|(_, line)| format!("{line}\n"));
    fs::write(&log, kept.collect::<String>()).unwrap();
    let mut learner = scratch.learner_with("run", setting, &["--listen", &endpoint]);
    assert_eq!(learner.process.wait(PATIENCE).code(), Some(1));
    for said in [&format!("without the snapshot of step {second}")[..], "but 1 episodes have no score", "hint: "] {
        assert!(learner.process.log().contains(said), "{}", learner.process.log());
    }
}
