//! Fault upon fault at random moments, and at the end a run that is, bit for bit, the one that nothing happened to.
//!
//! A short round runs with all tests. A long one, whose result is in docs/reliability.md:
//! `QUAD_FAULTS=200 cargo test --release --workspace --test chaos -- --nocapture`; QUAD_FAULTS_SEED chooses other faults.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::sleep;
use std::time::{Duration, Instant};

use quad_protocol::{EpisodeScore, Hash, Name, ScoreReply, ScoreReport, decode, encode, keys};
use quad_tests::link::Link;
use quad_tests::process::binary;
use quad_tests::router::router;
use quad_tests::system::{Evaluator, Learner, Score, Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually};
use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::runtime::Runtime;
use zenoh::query::ConsolidationMode;
use zenoh::{Session, Wait};

const EVALUATORS: usize = 3;
/// Gradient steps for each fault, so that training goes on until the last of them.
const STEPS_PER_FAULT: u64 = 6000;

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    KillEvaluator,
    FreezeEvaluator,
    StopEvaluator,
    CutEvaluator,
    FreezeEvaluatorsLink,
    DelayEvaluatorsLink,
    RestartRouter,
    KillLearner,
    StopLearner,
    FreezeLearner,
    CutLearner,
    FreezeLearnersLink,
    FillDisk,
    DeliverAgain,
}

const FAULTS: [Fault; 14] = [
    Fault::KillEvaluator,
    Fault::FreezeEvaluator,
    Fault::StopEvaluator,
    Fault::CutEvaluator,
    Fault::FreezeEvaluatorsLink,
    Fault::DelayEvaluatorsLink,
    Fault::RestartRouter,
    Fault::KillLearner,
    Fault::StopLearner,
    Fault::FreezeLearner,
    Fault::CutLearner,
    Fault::FreezeLearnersLink,
    Fault::FillDisk,
    Fault::DeliverAgain,
];

/// A router, a learner and some evaluators, each behind a link of its own.
struct System {
    scratch: Scratch,
    setting: Setting,
    runtime: Runtime,
    port: u16,
    router: Option<Session>,
    learner: Learner,
    learners_link: Link,
    evaluators: Vec<(Evaluator, Link)>,
    started: usize,
    /// The run's folder is a disk of its own, which can be filled.
    disk: bool,
    faults: BTreeMap<Fault, usize>,
}

impl System {
    fn start(setting: Setting) -> System {
        let scratch = Scratch::new();
        let run = scratch.path().join("run");
        fs::create_dir(&run).unwrap();
        let disk = Command::new("mount").args(["-t", "tmpfs", "-o", "size=64m", "tmpfs"]).arg(&run).status();
        let disk = disk.is_ok_and(|status| status.success());
        let runtime = Runtime::new().unwrap();
        let port = free_port();
        let session = runtime.block_on(router(&format!("tcp/127.0.0.1:{port}")));
        let learners_link = Link::to(port);
        let learner = learner(&scratch, setting, &learners_link);
        let mut system = System {
            scratch,
            setting,
            runtime,
            port,
            router: Some(session),
            learner,
            learners_link,
            evaluators: Vec::new(),
            started: 0,
            disk,
            faults: BTreeMap::new(),
        };
        for _ in 0..EVALUATORS {
            let link = Link::to(port);
            let evaluator = system.evaluator(&link);
            system.evaluators.push((evaluator, link));
        }
        system
    }

    fn evaluator(&mut self, link: &Link) -> Evaluator {
        self.started += 1;
        self.scratch.evaluator_with(&format!("evaluator-{}", self.started), &["--connect", &link.endpoint])
    }

    /// Whether the learner has reached its end. If it has ended in any other way, that is a bug.
    fn is_over(&mut self) -> bool {
        if self.learner.process.is_running() {
            return false;
        }
        let status = self.learner.process.wait(PATIENCE);
        assert!(status.success(), "the learner ended by itself with {status}");
        true
    }

    fn inject(&mut self, fault: Fault, random: &mut ChaCha8Rng) {
        // Zenoh gives up a silent connection after 5 s: some are shorter, some are longer.
        let a_while = Duration::from_millis(random.random_range(100..7000));
        let victim = random.random_range(0..EVALUATORS);
        match fault {
            Fault::KillEvaluator => {
                self.evaluators[victim].0.process.kill();
                self.replace(victim);
            }
            Fault::FreezeEvaluator => {
                let process = &self.evaluators[victim].0.process;
                process.signal("STOP");
                sleep(a_while);
                process.signal("CONT");
            }
            Fault::StopEvaluator => {
                let (duration, _) = self.evaluators[victim].0.process.terminate(PATIENCE);
                assert!(duration < Duration::from_secs(10), "an evaluator took {duration:?} to leave");
                self.replace(victim);
            }
            Fault::CutEvaluator => self.evaluators[victim].1.cut(),
            Fault::FreezeEvaluatorsLink => freeze(&self.evaluators[victim].1, a_while),
            Fault::DelayEvaluatorsLink => {
                let link = &self.evaluators[victim].1;
                link.delay(a_while / 20);
                sleep(a_while / 2);
                link.delay(Duration::ZERO);
            }
            Fault::RestartRouter => {
                let session = self.router.take().expect("it is there");
                session.close().wait().ok();
                sleep(a_while / 4);
                let endpoint = format!("tcp/127.0.0.1:{}", self.port);
                self.router = Some(self.runtime.block_on(router(&endpoint)));
            }
            Fault::KillLearner => {
                self.learner.process.kill();
                self.restart_learner();
            }
            Fault::StopLearner => {
                let (duration, _) = self.learner.process.terminate(PATIENCE);
                assert!(duration < Duration::from_secs(10), "the learner took {duration:?} to leave");
                self.restart_learner();
            }
            Fault::FreezeLearner => {
                self.learner.process.signal("STOP");
                sleep(a_while);
                self.learner.process.signal("CONT");
            }
            Fault::CutLearner => self.learners_link.cut(),
            Fault::FreezeLearnersLink => freeze(&self.learners_link, a_while),
            Fault::FillDisk if self.disk => {
                let filler = self.learner.run_dir.join("filler");
                let mut file = fs::File::create(&filler).unwrap();
                while std::io::Write::write_all(&mut file, &[0; 4096]).is_ok() {}
                sleep(a_while / 2);
                fs::remove_file(filler).unwrap();
            }
            Fault::FillDisk => return,
            Fault::DeliverAgain => self.deliver_again(),
        }
        *self.faults.entry(fault).or_default() += 1;
    }

    fn replace(&mut self, index: usize) {
        let link = self.evaluators[index].1.clone();
        self.evaluators[index].0 = self.evaluator(&link);
    }

    fn restart_learner(&mut self) {
        self.learner = learner(&self.scratch, self.setting, &self.learners_link);
    }

    /// Delivers what is recorded once more, by somebody else.
    fn deliver_again(&self) {
        let scores = self.learner.scores();
        let Some(step) = scores.last().map(|score| score.integer("step")) else { return };
        let of_step: Vec<&Score> = scores.iter().filter(|score| score.integer("step") == step).collect();
        let episodes = of_step.iter().map(|score| EpisodeScore {
            seed: score.integer("seed"),
            episode_return: score.number("return"),
            length: score.integer("length") as u32,
            score: score.number("score"),
        });
        let name = |text: &str| Name::new(text).unwrap();
        let tensors = fs::read(self.learner.snapshot(step)).unwrap();
        let report = ScoreReport {
            evaluator: name("echo"),
            run: name("run"),
            incarnation: 1,
            job: 1,
            step,
            weights: Hash::of(&tensors),
            precision: name(of_step[0].text("precision")),
            episodes: episodes.collect(),
            cannot_act: None,
        };
        let query = self.router.as_ref().expect("it is there").get(keys::scores(&report.run));
        let query = query.payload(encode(&report).unwrap()).consolidation(ConsolidationMode::None);
        let replies = query.timeout(Duration::from_secs(2)).wait().unwrap();
        // The learner may be away just now.
        while let Ok(reply) = replies.recv() {
            let Ok(sample) = reply.into_result() else { continue };
            let reply = decode::<ScoreReply>(&sample.payload().to_bytes()).unwrap();
            assert!(matches!(reply, ScoreReply::Recorded { new: 0, .. }), "{reply:?}");
        }
    }
}

impl Drop for System {
    fn drop(&mut self) {
        if self.disk {
            Command::new("umount").arg("--lazy").arg(&self.learner.run_dir).status().ok();
        }
    }
}

fn learner(scratch: &Scratch, setting: Setting, link: &Link) -> Learner {
    scratch.learner_with("run", setting, &["--connect", &link.endpoint, "--checkpoint-seconds", "1"])
}

fn freeze(link: &Link, a_while: Duration) {
    link.freeze(true);
    sleep(a_while);
    link.freeze(false);
}

fn verify(run: &Path, other: &Path) -> (bool, String) {
    let output = Command::new(binary("learner")).arg("verify").arg(run).arg("--same-as").arg(other).output().unwrap();
    (output.status.success(), String::from_utf8_lossy(&output.stdout).into_owned())
}

fn number(variable: &str, default: u64) -> u64 {
    std::env::var(variable).map_or(default, |text| text.parse().expect("a number"))
}

#[test]
fn whatever_happens_the_run_ends_as_if_nothing_had() {
    let (count, seed) = (number("QUAD_FAULTS", FAULTS.len() as u64), number("QUAD_FAULTS_SEED", 1));
    let setting = Setting {
        steps: STEPS_PER_FAULT * count,
        eval_interval: STEPS_PER_FAULT / 2,
        episodes: 4,
        candidates: 20,
        hidden: 64,
        seed: 9,
    };
    let begin = Instant::now();
    let scratch = Scratch::new();
    let mut calm = scratch.learner("calm", setting);
    let _evaluator = scratch.evaluator("calm-evaluator", &calm.endpoint());

    let mut system = System::start(setting);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut injected, mut round) = (0, Vec::new());
    while injected < count && !system.is_over() {
        sleep(Duration::from_millis(random.random_range(0..1500)));
        // Each kind once a round, in another order each time.
        if round.is_empty() {
            round = FAULTS.to_vec();
            round.shuffle(&mut random);
        }
        system.inject(round.pop().expect("it was filled"), &mut random);
        injected += 1;
    }
    let patience = PATIENCE + begin.elapsed();
    eventually("the run is over", patience, || system.is_over().then_some(()));
    let status = calm.process.wait(patience);
    assert!(status.success(), "the run that nothing happens to ended with {status}");

    let (held, found) = verify(&system.learner.run_dir, &calm.run_dir);
    assert!(held, "{found}");
    let last = |learner: &Learner| -> PathBuf {
        let folder = fs::read_dir(learner.run_dir.join("checkpoints")).unwrap();
        folder.map(|entry| entry.unwrap().path()).max().unwrap()
    };
    assert!(fs::read(last(&system.learner)).unwrap() == fs::read(last(&calm)).unwrap(), "the last checkpoints differ");
    eprintln!("{injected} faults in {:.0?}: {:?}\n{found}", begin.elapsed(), system.faults);
    assert!(injected >= count / 2, "the run was over after {injected} of {count} faults");
}
