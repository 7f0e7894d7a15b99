//! Power cuts: what was promised to be on the disk is there when nothing else is.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::Duration;

use quad_protocol::{Hash, Name, RecordedScores, decode, keys};
use quad_tests::power::Disk;
use quad_tests::process::binary;
use quad_tests::router::router;
use quad_tests::system::{Evaluator, Learner, Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::runtime::Runtime;
use zenoh::{Session, Wait};

const SETTING: Setting =
    Setting { steps: 48_000, eval_interval: 1200, episodes: 4, candidates: 2, hidden: 64, seed: 5 };
const CUTS: usize = 8;

/// A score: step, seed, weights.
type Key = (u64, u64, String);

/// A learner on a disk that forgets what was not synchronised, evaluators, and a router that outlives them all.
struct System {
    scratch: Scratch,
    disk: Disk,
    endpoint: String,
    _evaluators: Vec<Evaluator>,
    /// The scores that the learner said are recorded. It thanks an evaluator no sooner.
    recorded: Arc<Mutex<BTreeSet<Key>>>,
    _router: Session,
    _runtime: Runtime,
}

impl System {
    fn start() -> System {
        // Beside the test's program: where a container keeps temporary files, its filesystem may fail when somebody who writes
        // is killed.
        let program = std::env::current_exe().unwrap();
        let scratch = Scratch::inside(program.parent().unwrap());
        let disk = Disk::new(scratch.path());
        let endpoint = format!("tcp/127.0.0.1:{}", free_port());
        let runtime = Runtime::new().unwrap();
        let session = runtime.block_on(router(&endpoint));
        let recorded = Arc::new(Mutex::new(BTreeSet::new()));
        let heard = recorded.clone();
        let listener = move |sample: zenoh::sample::Sample| {
            let RecordedScores { step, weights, episodes, .. } = decode(&sample.payload().to_bytes()).unwrap();
            let keys = episodes.iter().map(|episode| (step, episode.seed, weights.to_string()));
            heard.lock().unwrap().extend(keys);
        };
        let every_step = format!("{}/*", keys::scores(&Name::new("run").unwrap()));
        session.declare_subscriber(every_step).callback(listener).background().wait().unwrap();
        let evaluators = ["one", "two"].map(|name| scratch.evaluator_with(name, &["--connect", &endpoint])).into();
        System { scratch, disk, endpoint, _evaluators: evaluators, recorded, _router: session, _runtime: runtime }
    }

    /// Its run's folder and the folder above it are not there at first.
    fn learner(&self) -> Learner {
        let arguments = ["--connect", &self.endpoint, "--checkpoint-seconds", "0"];
        self.scratch.learner_through(&self.disk.launcher(), "disk/runs/run", SETTING, &arguments)
    }

    /// Lets a learner run into a random moment: mostly of its training, at times of its start.
    fn run_for_a_while(&self, random: &mut ChaCha8Rng) -> Learner {
        let mut learner = self.learner();
        if random.random_bool(0.75) {
            let process = &mut learner.process;
            eventually("the learner trains, or has ended", PATIENCE, || {
                let trains = process.log().contains("snapshot handed to evaluation");
                (trains || !process.is_running()).then_some(())
            });
        }
        sleep(Duration::from_millis(random.random_range(0..1000)));
        learner
    }

    /// Cuts the power; what was promised must be left.
    fn cut_power(&self, learner: &mut Learner) {
        learner.process.kill();
        let folders = ["snapshots", "checkpoints"].map(|name| learner.run_dir.join(name));
        let before = folders.each_ref().map(|folder| files(folder));
        self.disk.cut_power();

        // One thread writes these, a file after the other: only the last one may be on its way.
        for (mut before, folder) in before.into_iter().zip(&folders) {
            before.pop_last();
            let after = files(folder);
            for (name, contents) in before {
                assert!(after.get(&name) == Some(&contents), "{name} is not on the disk");
            }
        }
        let left = keys_of(learner);
        for score in self.recorded.lock().unwrap().iter() {
            assert!(left.contains(score), "{score:?} was recorded, but is not on the disk");
        }
        for (step, seed, weights) in left {
            let snapshot = fs::read(learner.snapshot(step)).unwrap_or_default();
            assert_eq!(
                Hash::of(&snapshot).to_string(),
                weights,
                "the snapshot of step {step}, scored with seed {seed}"
            );
        }
    }

    /// Lets the run end, and compares it with one that nothing happened to.
    fn finish(&self) {
        let mut learner = self.learner();
        let status = learner.process.wait(3 * PATIENCE);
        assert!(status.success(), "the learner ended with {status}");
        learner.assert_complete(&SETTING);
        let mut calm = self.scratch.learner("calm", SETTING);
        let _evaluator = self.scratch.evaluator("three", &calm.endpoint());
        assert!(calm.process.wait(3 * PATIENCE).success());
        let mut verify = Command::new(binary("learner"));
        let output = verify.arg("verify").arg(&learner.run_dir).arg("--same-as").arg(&calm.run_dir).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
        let last = |learner: &Learner| files(&learner.run_dir.join("checkpoints")).pop_last().unwrap();
        assert!(last(&learner) == last(&calm), "the last checkpoints differ");
    }
}

/// The whole files of a folder, name by name; none if it is not there.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap());
    let files = entries.map(|entry| (entry.file_name().into_string().unwrap(), fs::read(entry.path()).unwrap()));
    files.filter(|(name, _)| !name.ends_with(".partial")).collect()
}

fn keys_of(learner: &Learner) -> BTreeSet<Key> {
    let key = |score: &quad_tests::system::Score| (score.key().0, score.key().1, score.text("weights").to_owned());
    learner.scores().iter().map(key).collect()
}

#[test]
fn a_power_cut_takes_nothing_that_was_promised() {
    let system = System::start();
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut gone_on = 0;
    for _ in 0..CUTS {
        let mut learner = system.run_for_a_while(&mut random);
        system.cut_power(&mut learner);
        let log = learner.process.log();
        gone_on += usize::from(log.contains("goes on after step") && !log.contains("goes on after step 0"));
        assert!(!log.contains("is damaged"), "{log}");
    }
    assert!(gone_on > CUTS / 2, "only {gone_on} of {CUTS} lives went on from a checkpoint");
    assert!(!system.recorded.lock().unwrap().is_empty(), "nothing was recorded before a power cut");
    system.finish();
}

#[test]
fn what_a_killed_learner_left_is_on_the_disk_before_another_builds_on_it() {
    let system = System::start();
    let mut random = ChaCha8Rng::seed_from_u64(2);
    for _ in 0..CUTS {
        let mut learner = system.run_for_a_while(&mut random);
        learner.process.kill();
        if !learner.run_dir.join("config.toml").exists() {
            continue;
        }
        let left = keys_of(&learner);
        let mut learner = system.learner();
        learner.process.wait_for_log("goes on after step", PATIENCE);
        system.recorded.lock().unwrap().extend(left);
        system.cut_power(&mut learner);
    }
    system.finish();
}
