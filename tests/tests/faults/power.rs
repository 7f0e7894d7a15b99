//! Power cuts: what was promised to be on the disk is there when nothing else is.

use std::collections::BTreeSet;
use std::fs;
use std::thread::sleep;
use std::time::Duration;

use quad_protocol::Hash;
use quad_tests::crowd::Crowd;
use quad_tests::learner::Learner;
use quad_tests::made_up::name;
use quad_tests::power::Disk;
use quad_tests::router::router;
use quad_tests::setting::{SHORT, Setting};
use quad_tests::system::{Scratch, free_endpoint};
use quad_tests::{PATIENCE, eventually};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::runtime::Runtime;
use zenoh::Session;

const STEPS_PER_CUT: u64 = 6000;
/// The longest of the evaluators' episodes.
const EPISODE: Duration = Duration::from_millis(10);

/// A score: step, seed, weights.
type Key = (u64, u64, String);

/// A learner on a disk that forgets what was not synchronized, evaluators, and a router that
/// outlives it.
struct System {
    setting: Setting,
    scratch: Scratch,
    disk: Disk,
    endpoint: String,
    crowd: Crowd,
    /// The scores that the learner has acknowledged, or that were on its disk when another one
    /// began.
    promised: BTreeSet<Key>,
    _router: Session,
    runtime: Runtime,
}

impl System {
    fn start(cuts: u64) -> System {
        let steps = STEPS_PER_CUT * cuts;
        let setting = Setting { steps, eval_interval: 1200, episodes: 4, hidden: 64, ..SHORT };
        // Beside the test's program: where a container keeps temporary files, its filesystem may
        // fail when a program that writes is killed.
        let program = std::env::current_exe().unwrap();
        let scratch = Scratch::inside(program.parent().unwrap());
        let (disk, promised) = (Disk::new(scratch.path()), BTreeSet::new());
        let (endpoint, runtime) = (free_endpoint(), Runtime::new().unwrap());
        let _router = runtime.block_on(router(&endpoint));
        let crowd = runtime.block_on(Crowd::connect(2, EPISODE, &name("run"), &endpoint));
        System { setting, scratch, disk, endpoint, crowd, promised, _router, runtime }
    }

    /// Its run's folder and the folder above it are not there at first.
    fn learner(&self) -> Learner {
        let arguments = ["--connect", &self.endpoint, "--checkpoint-seconds", "0"];
        let (scratch, launcher) = (&self.scratch, self.disk.launcher());
        scratch.learner_through(&launcher, "disk/runs/run", self.setting, &arguments)
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
    fn cut_power(&mut self, learner: &mut Learner, random: &mut ChaCha8Rng) {
        learner.process.kill();
        let folders = ["snapshots", "checkpoints"];
        let before = folders.map(|folder| learner.files(folder));
        self.disk.cut_power(random);

        // One thread writes these, a file after the other: only the last one may be on its way.
        for (mut before, folder) in before.into_iter().zip(folders) {
            before.pop_last();
            let after = learner.files(folder);
            for (name, contents) in before {
                assert!(after.get(&name) == Some(&contents), "{name} is not on the disk");
            }
        }
        let left = keys_of(learner);
        self.promised.extend(self.crowd.measured().acknowledged);
        for score in &self.promised {
            assert!(left.contains(score), "{score:?} was acknowledged, but is not on the disk");
        }
        for (step, seed, weights) in left {
            let snapshot = fs::read(learner.snapshot(step)).unwrap_or_default();
            assert_eq!(
                Hash::new(&snapshot).to_string(),
                weights,
                "the snapshot of step {step}, scored with seed {seed}"
            );
        }
    }

    /// Lets the run end, and compares it with one that nothing happened to.
    fn finish(self) {
        let mut learner = self.learner();
        learner.assert_completes(3 * PATIENCE);
        let mut calm = self.scratch.learner("calm", self.setting);
        let (run, endpoint) = (name("calm"), calm.endpoint());
        let _crowd = self.runtime.block_on(Crowd::connect(2, EPISODE, &run, &endpoint));
        calm.assert_completes(3 * PATIENCE);
        learner.assert_same_as(&calm);
        // A run that is complete is so at once.
        let mut again = self.learner();
        again.process.assert_succeeds(PATIENCE);
        let out = again.process.out();
        assert!(out.contains("mean score of the last 3 evaluations"), "{out}");
        again.assert_same_as(&calm);
    }
}

fn keys_of(learner: &Learner) -> BTreeSet<Key> {
    let scores = learner.scores();
    scores.iter().map(|score| (score.step, score.seed, score.weights.clone())).collect()
}

/// Cuts the power of a learner at work, again and again. Before some cuts the learner is killed,
/// and another one builds on what it left.
fn cut_power(cuts: u64) {
    let mut system = System::start(cuts);
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut gone_on = 0;
    for cut in 0..cuts {
        let mut learner = system.run_for_a_while(&mut random);
        if cut == 1 {
            // However slow the machine is, something was promised, and there is a checkpoint.
            learner.wait_for_scores(0);
            eventually("there is a checkpoint", PATIENCE, || {
                learner.files("checkpoints").pop_first()
            });
        }
        if cut % 2 == 1 && learner.run_dir.join("config.toml").exists() {
            learner.process.kill();
            system.promised.extend(keys_of(&learner));
            learner = system.learner();
            learner.process.wait_for_log("continues after step", PATIENCE);
        }
        system.cut_power(&mut learner, &mut random);
        let log = learner.process.log();
        let goes_on = |text| log.contains(text);
        gone_on += u64::from(goes_on("continues after step") && !goes_on("continues after step 0"));
        learner.process.assert_not_said("is damaged");
    }
    assert!(gone_on >= cuts / 2, "only {gone_on} of {cuts} continued from a checkpoint");
    assert!(!system.promised.is_empty(), "nothing was acknowledged before a power cut");
    system.finish();
}

#[test]
fn two_power_cuts_lose_nothing_acknowledged() {
    cut_power(2);
}

#[test]
#[ignore = "two minutes"]
fn sixteen_power_cuts_lose_nothing_acknowledged() {
    cut_power(16);
}
