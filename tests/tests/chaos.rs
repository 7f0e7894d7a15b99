//! Fault upon fault at random moments, and at the end a run that is, bit for bit, the one that nothing happened to.
//!
//! Once with the connections of one machine, once with a host for each program, on a network whose packets go astray.
//! Short rounds run with all tests. Long ones, whose results are in docs/reliability.md:
//! `QUAD_FAULTS=200 cargo test --release --workspace --test chaos -- --nocapture`; QUAD_FAULTS_SEED chooses other faults.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::sleep;
use std::time::{Duration, Instant};

use quad_protocol::{EpisodeScore, Hash, Name, ScoreReply, ScoreReport, decode, encode, keys};
use quad_tests::hosts::{Host, Network};
use quad_tests::line::{Line, Trouble};
use quad_tests::link::Link;
use quad_tests::process::binary;
use quad_tests::router::router;
use quad_tests::system::{Evaluator, Learner, Score, Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, number};
use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::runtime::Runtime;
use zenoh::query::ConsolidationMode;
use zenoh::{Session, Wait};

const EVALUATORS: usize = 3;
/// Gradient steps for each fault, so that training goes on until the last of them.
const STEPS_PER_FAULT: u64 = 12_000;

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    KillEvaluator,
    FreezeEvaluator,
    StopEvaluator,
    EvaluatorsLine(Trouble),
    RestartRouter,
    KillLearner,
    StopLearner,
    FreezeLearner,
    LearnersLine(Trouble),
    FillDisk,
    DeliverAgain,
}

/// What happens to programs and their disk.
const FAULTS: [Fault; 9] = [
    Fault::KillEvaluator,
    Fault::FreezeEvaluator,
    Fault::StopEvaluator,
    Fault::RestartRouter,
    Fault::KillLearner,
    Fault::StopLearner,
    Fault::FreezeLearner,
    Fault::FillDisk,
    Fault::DeliverAgain,
];

/// What happens on the way between them.
fn faults_on<L: Line>() -> Vec<Fault> {
    L::TROUBLES.iter().flat_map(|&trouble| [Fault::EvaluatorsLine(trouble), Fault::LearnersLine(trouble)]).collect()
}

/// A router, a learner and some evaluators, each at the end of a line of its own.
struct System<L> {
    scratch: Scratch,
    setting: Setting,
    runtime: Runtime,
    endpoint: String,
    router: Option<Session>,
    learner: Learner,
    learners_line: L,
    evaluators: Vec<(Evaluator, L)>,
    started: usize,
    /// The run's folder is a disk of its own, which can be filled.
    disk: bool,
    faults: BTreeMap<Fault, usize>,
}

impl<L: Line> System<L> {
    /// With a router that listens at `endpoint`, where all lines lead to: the learner's and each evaluator's.
    fn start(setting: Setting, endpoint: &str, mut lines: Vec<L>) -> System<L> {
        let scratch = Scratch::new();
        let run = scratch.path().join("run");
        fs::create_dir(&run).unwrap();
        let disk = Command::new("mount").args(["-t", "tmpfs", "-o", "size=64m", "tmpfs"]).arg(&run).status();
        let disk = disk.is_ok_and(|status| status.success());
        let runtime = Runtime::new().unwrap();
        let session = runtime.block_on(router(endpoint));
        let learners_line = lines.pop().expect("there are lines");
        let learner = learner(&scratch, setting, &learners_line);
        let mut system = System {
            scratch,
            setting,
            runtime,
            endpoint: endpoint.to_owned(),
            router: Some(session),
            learner,
            learners_line,
            evaluators: Vec::new(),
            started: 0,
            disk,
            faults: BTreeMap::new(),
        };
        for line in lines {
            let evaluator = system.evaluator(&line);
            system.evaluators.push((evaluator, line));
        }
        system
    }

    fn evaluator(&mut self, line: &L) -> Evaluator {
        self.started += 1;
        let name = format!("evaluator-{}", self.started);
        self.scratch.evaluator_through(&line.launcher(), &name, &["--connect", &line.endpoint()])
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
        // Zenoh gives up a silent connection after 5 s: most are shorter, some are longer.
        let a_while = Duration::from_secs_f64(0.1 + 6.9 * random.random::<f64>().powi(2));
        let percent = random.random_range(1..=100);
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
            Fault::EvaluatorsLine(trouble) => self.evaluators[victim].1.suffer(trouble, percent, a_while),
            Fault::RestartRouter => {
                let session = self.router.take().expect("it is there");
                session.close().wait().ok();
                sleep(a_while / 4);
                self.router = Some(self.runtime.block_on(router(&self.endpoint)));
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
            Fault::LearnersLine(trouble) => self.learners_line.suffer(trouble, percent, a_while),
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
        let (_, line) = self.evaluators.remove(index);
        let evaluator = self.evaluator(&line);
        self.evaluators.insert(index, (evaluator, line));
    }

    fn restart_learner(&mut self) {
        self.learner = learner(&self.scratch, self.setting, &self.learners_line);
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

impl<L> Drop for System<L> {
    fn drop(&mut self) {
        if self.disk {
            Command::new("umount").arg("--lazy").arg(&self.learner.run_dir).status().ok();
        }
    }
}

fn learner(scratch: &Scratch, setting: Setting, line: &impl Line) -> Learner {
    let arguments = ["--connect", &line.endpoint(), "--checkpoint-seconds", "1"];
    scratch.learner_through(&line.launcher(), "run", setting, &arguments)
}

fn verify(run: &Path, other: &Path) -> (bool, String) {
    let output = Command::new(binary("learner")).arg("verify").arg(run).arg("--same-as").arg(other).output().unwrap();
    (output.status.success(), String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Lets faults of those kinds happen, so many of them unless a long round is asked for.
fn endure(faults: &[Fault], short: usize, endpoint: &str, lines: Vec<impl Line>) {
    let (count, seed) = (number("QUAD_FAULTS", short as u64), number("QUAD_FAULTS_SEED", 1));
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

    let mut system = System::start(setting, endpoint, lines);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
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

#[test]
fn whatever_happens_the_run_ends_as_if_nothing_had() {
    let port = free_port();
    let faults = [&FAULTS[..], &faults_on::<Link>()].concat();
    let lines = (0..=EVALUATORS).map(|_| Link::to(port)).collect();
    endure(&faults, faults.len(), &format!("tcp/127.0.0.1:{port}"), lines);
}

#[test]
fn so_does_a_run_whose_learner_and_evaluators_are_hosts_on_a_bad_network() {
    let port = free_port();
    let network = match Network::new() {
        Ok(network) => network,
        Err(reason) => return eprintln!("skipped, because there can be no network of hosts here: {reason}"),
    };
    let lines = (1..=EVALUATORS as u32 + 1).map(|number| network.host(number, port).unwrap()).collect();
    // The other test lets programs die, too; here they do so in a long round only.
    let programs: &[Fault] = if std::env::var_os("QUAD_FAULTS").is_some() { &FAULTS } else { &[] };
    let faults = [programs, &faults_on::<Host>()].concat();
    endure(&faults, Host::TROUBLES.len(), &format!("tcp/{}:{port}", network.address), lines);
}
