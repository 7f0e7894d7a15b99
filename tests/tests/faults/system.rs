//! A router, a learner and some evaluators, and what can happen to each of them.

use std::collections::BTreeMap;
use std::fs;
use std::thread::sleep;
use std::time::Duration;

use quad_protocol::{Hash, ScoreReply, ScoreReport, decode, encode, keys};
use quad_run::folder::ScoreLine;
use quad_tests::PATIENCE;
use quad_tests::learner::Learner;
use quad_tests::link::{Link, Trouble};
use quad_tests::made_up::name;
use quad_tests::process::Process;
use quad_tests::router::router;
use quad_tests::setting::Setting;
use quad_tests::small_disk::SmallDisk;
use quad_tests::system::{Evaluator, Scratch, free_port};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use tokio::runtime::Runtime;
use zenoh::query::ConsolidationMode;
use zenoh::{Session, Wait};

const EVALUATORS: usize = 3;

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
    Link(Program, Trouble),
    RestartRouter,
    FillDisk,
    DeliverAgain,
}

/// All that can happen.
pub fn all_faults() -> Vec<Fault> {
    let mut all = vec![Fault::RestartRouter, Fault::FillDisk, Fault::DeliverAgain];
    for program in [Program::Learner, Program::Evaluator] {
        all.extend([Fault::Kill(program), Fault::Stop(program), Fault::Freeze(program)]);
        all.extend(Trouble::ALL.map(|trouble| Fault::Link(program, trouble)));
    }
    all
}

/// Each program is at the end of a link of its own.
pub struct System {
    setting: Setting,
    runtime: Runtime,
    endpoint: String,
    router: Option<Session>,
    pub learner: Learner,
    learners_link: Link,
    evaluators: Vec<(Evaluator, Link)>,
    started: usize,
    /// Disk of the run's folder, where it can be a disk of its own.
    disk: Option<SmallDisk>,
    /// Count of each fault.
    pub faults: BTreeMap<Fault, usize>,
    scratch: Scratch,
}

impl System {
    /// All programs are on this machine, and linked to a router.
    pub fn start(setting: Setting) -> System {
        let scratch = Scratch::new();
        let disk = SmallDisk::mount(&scratch.path().join("run"), 64);
        let (runtime, port) = (Runtime::new().unwrap(), free_port());
        let endpoint = format!("tcp/127.0.0.1:{port}");
        let session = runtime.block_on(router(&endpoint));
        let learners_link = Link::to(port);
        let learner = learner(&scratch, setting, &learners_link);
        let mut system = System {
            setting,
            runtime,
            endpoint,
            router: Some(session),
            learner,
            learners_link,
            evaluators: Vec::new(),
            started: 0,
            disk,
            faults: BTreeMap::new(),
            scratch,
        };
        for link in (0..EVALUATORS).map(|_| Link::to(port)) {
            let evaluator = system.evaluator(&link);
            system.evaluators.push((evaluator, link));
        }
        system
    }

    fn evaluator(&mut self, link: &Link) -> Evaluator {
        self.started += 1;
        let name = format!("evaluator-{}", self.started);
        self.scratch.evaluator_with(&name, &["--connect", &link.endpoint])
    }

    /// True if the learner has completed its run. Any other end is a bug.
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
            Fault::Link(Program::Learner, trouble) => {
                self.learners_link.suffer(trouble, percent, a_while)
            }
            Fault::Link(Program::Evaluator, trouble) => {
                self.evaluators[victim].1.suffer(trouble, percent, a_while)
            }
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
            Program::Learner => {
                self.learner = learner(&self.scratch, self.setting, &self.learners_link)
            }
            Program::Evaluator => {
                let (_, link) = self.evaluators.remove(index);
                let evaluator = self.evaluator(&link);
                self.evaluators.insert(index, (evaluator, link));
            }
        }
    }

    /// Delivers scores that are recorded once more, under the name of another evaluator.
    fn deliver_again(&self) {
        let scores = self.learner.scores();
        let Some(last) = scores.last() else { return };
        let step = last.step;
        let episodes = scores.iter().filter(|score| score.step == step).map(ScoreLine::episode);
        let report = ScoreReport {
            evaluator: name("echo"),
            run: name("run"),
            incarnation: 1,
            job: 1,
            step,
            weights: Hash::new(&fs::read(self.learner.snapshot(step)).unwrap()),
            precision: name(&last.precision),
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

fn learner(scratch: &Scratch, setting: Setting, link: &Link) -> Learner {
    let connect = ["--connect", &link.endpoint, "--checkpoint-seconds", "1"];
    scratch.learner_with("run", setting, &connect)
}
