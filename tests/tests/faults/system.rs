//! A router, a learner and some evaluators, and what can happen to each of them.

use std::collections::BTreeMap;
use std::fs;
use std::thread::sleep;
use std::time::Duration;

use quad_protocol::{EpisodeScore, Hash, ScoreReply, ScoreReport, decode, encode, keys};
use quad_tests::PATIENCE;
use quad_tests::learner::Learner;
use quad_tests::line::{Line, Trouble};
use quad_tests::made_up::name;
use quad_tests::process::Process;
use quad_tests::router::router;
use quad_tests::setting::Setting;
use quad_tests::small_disk::SmallDisk;
use quad_tests::system::{Evaluator, Scratch};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use tokio::runtime::Runtime;
use zenoh::query::ConsolidationMode;
use zenoh::{Session, Wait};

pub const EVALUATORS: usize = 3;

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Program {
    Learner,
    Evaluator,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fault {
    Kill(Program),
    Stop(Program),
    Freeze(Program),
    Line(Program, Trouble),
    RestartRouter,
    FillDisk,
    DeliverAgain,
}

/// All that can happen where lines are of kind `L`.
pub fn all_faults<L: Line>() -> Vec<Fault> {
    let of = |program| {
        let lines = L::TROUBLES.iter().map(move |&trouble| Fault::Line(program, trouble));
        [Fault::Kill(program), Fault::Stop(program), Fault::Freeze(program)].into_iter().chain(lines)
    };
    let others = [Fault::RestartRouter, Fault::FillDisk, Fault::DeliverAgain];
    of(Program::Learner).chain(of(Program::Evaluator)).chain(others).collect()
}

/// Each program is at the end of a line of its own.
pub struct System<L> {
    setting: Setting,
    runtime: Runtime,
    endpoint: String,
    router: Option<Session>,
    pub learner: Learner,
    learners_line: L,
    evaluators: Vec<(Evaluator, L)>,
    started: usize,
    /// Disk of the run's folder, where it can be a disk of its own.
    disk: Option<SmallDisk>,
    /// How often each fault has happened.
    pub faults: BTreeMap<Fault, usize>,
    scratch: Scratch,
}

impl<L: Line> System<L> {
    /// With a router that listens at `endpoint`, where all lines lead to: the learner's and each evaluator's.
    pub fn start(setting: Setting, endpoint: &str, mut lines: Vec<L>) -> System<L> {
        let scratch = Scratch::new();
        let disk = SmallDisk::mount(&scratch.path().join("run"), 64);
        let runtime = Runtime::new().unwrap();
        let session = runtime.block_on(router(endpoint));
        let learners_line = lines.pop().expect("there are lines");
        let learner = learner(&scratch, setting, &learners_line);
        let mut system = System {
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
            scratch,
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
    pub fn is_over(&mut self) -> bool {
        let over = !self.learner.process.is_running();
        if over {
            self.learner.process.assert_succeeds(PATIENCE);
        }
        over
    }

    pub fn inject(&mut self, fault: Fault, random: &mut ChaCha8Rng) {
        // Zenoh gives up a silent connection after 5 s: most are shorter, some are longer.
        let a_while = Duration::from_secs_f64(0.1 + 6.9 * random.random::<f64>().powi(2));
        let percent = random.random_range(1..=100);
        let victim = random.random_range(0..EVALUATORS);
        match fault {
            Fault::Kill(program) => {
                self.process(program, victim).kill();
                self.restart(program, victim);
            }
            Fault::Stop(program) => {
                let process = self.process(program, victim);
                process.signal("TERM");
                process.wait(PATIENCE);
                self.restart(program, victim);
            }
            Fault::Freeze(program) => {
                let process = self.process(program, victim);
                process.signal("STOP");
                sleep(a_while);
                process.signal("CONT");
            }
            Fault::Line(Program::Learner, trouble) => self.learners_line.suffer(trouble, percent, a_while),
            Fault::Line(Program::Evaluator, trouble) => self.evaluators[victim].1.suffer(trouble, percent, a_while),
            Fault::RestartRouter => {
                let session = self.router.take().expect("it is there");
                session.close().wait().ok();
                sleep(a_while / 4);
                self.router = Some(self.runtime.block_on(router(&self.endpoint)));
            }
            Fault::FillDisk => {
                let Some(disk) = &self.disk else { return };
                disk.fill();
                sleep(a_while / 2);
                disk.clear();
            }
            Fault::DeliverAgain => self.deliver_again(),
        }
        *self.faults.entry(fault).or_default() += 1;
    }

    fn process(&mut self, program: Program, index: usize) -> &mut Process {
        match program {
            Program::Learner => &mut self.learner.process,
            Program::Evaluator => &mut self.evaluators[index].0.process,
        }
    }

    fn restart(&mut self, program: Program, index: usize) {
        match program {
            Program::Learner => self.learner = learner(&self.scratch, self.setting, &self.learners_line),
            Program::Evaluator => {
                let (_, line) = self.evaluators.remove(index);
                let evaluator = self.evaluator(&line);
                self.evaluators.insert(index, (evaluator, line));
            }
        }
    }

    /// Delivers scores that are recorded once more, under the name of another evaluator.
    fn deliver_again(&self) {
        let scores = self.learner.scores();
        let Some(last) = scores.last() else { return };
        let step = last.integer("step");
        let episodes = scores.iter().filter(|score| score.integer("step") == step).map(|score| EpisodeScore {
            seed: score.integer("seed"),
            episode_return: score.number("return"),
            length: score.integer("length") as u32,
            score: score.number("score"),
        });
        let report = ScoreReport {
            evaluator: name("echo"),
            run: name("run"),
            incarnation: 1,
            job: 1,
            step,
            weights: Hash::of(&fs::read(self.learner.snapshot(step)).unwrap()),
            precision: name(last.text("precision")),
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

fn learner(scratch: &Scratch, setting: Setting, line: &impl Line) -> Learner {
    let arguments = ["--connect", &line.endpoint(), "--checkpoint-seconds", "1"];
    scratch.learner_through(&line.launcher(), "run", setting, &arguments)
}
