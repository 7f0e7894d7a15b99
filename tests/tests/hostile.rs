//! What strangers can do to a learner that listens: whatever they try, evaluators are served, memory is bounded, and
//! training goes on.
//!
//! With all tests each attack lasts a second. What docs/reliability.md says of training's speed meanwhile comes from
//! `QUAD_SECONDS=3 QUAD_ROUNDS=3 cargo test --release --workspace --test hostile -- --nocapture`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::path::Path;
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use quad_protocol::{Name, WeightsRequest, encode, keys};
use quad_service::{Endpoints, open_session};
use quad_tests::crowd::{Crowd, Pace};
use quad_tests::knock::knock;
use quad_tests::made_up::{self, name};
use quad_tests::pace::{ENDLESS, compare, median, on_core};
use quad_tests::pieces::Pieces;
use quad_tests::process::Process;
use quad_tests::router::router;
use quad_tests::system::{Learner, Scratch, free_port};
use quad_tests::{PATIENCE, eventually, http, number};
use tokio::runtime::Runtime;
use zenoh::Session;

/// Of the evaluators that are served meanwhile.
const HONEST: usize = 5;
/// Tells this program that it is the stranger, and what he tries at which endpoint.
const STRANGER: &str = "QUAD_TEST_STRANGER";

#[derive(Clone, Copy, Debug)]
enum Attack {
    /// For comparison: he only keeps a core busy.
    Nothing,
    Progress,
    Claims,
    LyingReports,
    Garbage,
    Elsewhere,
    QuestionsElsewhere,
    /// Under keys that no pattern fits, not even a learner's own for what is none of its business.
    Unseen,
    /// Of what evaluators tell.
    Deletions,
    Subscriptions,
    /// Of weights, under several names, and he reads them.
    Downloads,
    /// Of evaluators, of learners, and others.
    Tokens,
    /// Made-up ones, with tokens, that ask for work and leave.
    Evaluators,
    Connections,
    ReadsNothing,
    /// Of a message that never ends.
    Pieces,
}

const ATTACKS: [Attack; 16] = [
    Attack::Nothing,
    Attack::Progress,
    Attack::Claims,
    Attack::LyingReports,
    Attack::Garbage,
    Attack::Elsewhere,
    Attack::QuestionsElsewhere,
    Attack::Unseen,
    Attack::Deletions,
    Attack::Downloads,
    Attack::Subscriptions,
    Attack::Connections,
    Attack::ReadsNothing,
    Attack::Evaluators,
    Attack::Tokens,
    Attack::Pieces,
];

fn run() -> Name {
    name("run")
}

/// One of many ways to write what a learner's weights fit: with a wildcard in place of each letter whose bit is set.
fn matches_weights(number: usize) -> String {
    let mut pattern = String::new();
    for (place, letter) in keys::weights(&run()).chars().rev().enumerate() {
        if letter == '/' || number >> place & 1 == 0 {
            pattern.push(letter);
        } else if !pattern.ends_with("*$") {
            pattern.push_str("*$");
        }
    }
    let pattern: String = pattern.chars().rev().collect();
    pattern.split('/').map(|chunk| if chunk == "$*" { "*" } else { chunk }).collect::<Vec<_>>().join("/")
}

/// Somebody who attacks, in a process of his own: what his Zenoh waits for must not hold up the evaluators.
fn start_stranger(attack: Attack, endpoint: &str, folder: &Path) -> Process {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "whatever_strangers_do_the_work_goes_on"]).env(STRANGER, format!("{attack:?} {endpoint}"));
    Process::start("stranger", folder, command)
}

/// What the stranger's process does, until it is killed.
fn be_a_stranger(what: &str) {
    let (attack, endpoint) = what.split_once(' ').unwrap();
    let attack = *ATTACKS.iter().find(|one| format!("{one:?}") == attack).unwrap();
    let runtime = Runtime::new().unwrap();
    match attack {
        Attack::ReadsNothing => runtime.block_on(read_nothing(endpoint)),
        Attack::Connections => knock(&endpoint.trim_start_matches("tcp/").parse().unwrap(), &AtomicBool::new(true)),
        Attack::Pieces => {
            let mut stranger = Pieces::connect(endpoint);
            loop {
                stranger.piece(b"x", false);
            }
        }
        attack => runtime.block_on(flood(attack, endpoint)),
    }
}

async fn open(endpoint: &str) -> Session {
    open_session(&Endpoints { connect: vec![endpoint.to_owned()], ..Endpoints::default() }).await.unwrap()
}

/// Sends as fast as the connection takes it.
async fn flood(attack: Attack, endpoint: &str) {
    let session = open(endpoint).await;
    let run = run();
    let ask = async |key: String, question: Vec<u8>| {
        session.get(key).payload(question).timeout(Duration::from_secs(1)).callback(drop).await.unwrap();
    };
    let claim_of = |evaluator: &str| encode(&made_up::claim(evaluator, 1, "moon")).unwrap();
    let (progress, claim) = (encode(&made_up::progress(&run, "flood", 1)).unwrap(), claim_of("flood"));
    let report = encode(&made_up::report(&run, ENDLESS.eval_interval, 1)).unwrap();
    let mut noise: Vec<u8> = (0..1000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let mut newer = claim.clone();
    newer[4] ^= 0xff;
    let (mut tokens, mut subscriptions, mut number) = (Vec::new(), Vec::new(), 0);
    loop {
        match attack {
            Attack::Progress => session.put(keys::progress(&run, &name("flood")), progress.clone()).await.unwrap(),
            Attack::Claims => ask(keys::jobs(&run), claim.clone()).await,
            Attack::LyingReports => ask(keys::scores(&run), report.clone()).await,
            Attack::Garbage => {
                noise.rotate_left(1);
                session.put(keys::progress(&run, &name("noise")), noise.clone()).await.unwrap();
                session.put("quad/run/anything", noise.clone()).await.unwrap();
                ask(keys::jobs(&run), newer.clone()).await;
                ask(keys::weights_at(&run, 1), noise.clone()).await;
            }
            Attack::Nothing => {}
            Attack::Elsewhere => session.put("somewhere/else", progress.clone()).await.unwrap(),
            Attack::QuestionsElsewhere => ask("somewhere/else".to_owned(), claim.clone()).await,
            Attack::Unseen => session.put("@somewhere/else", progress.clone()).await.unwrap(),
            Attack::Deletions => session.delete(keys::progress(&run, &name("flood"))).await.unwrap(),
            Attack::Downloads => {
                number += 1;
                let question = encode(&WeightsRequest { evaluator: name(&format!("flood-{}", number % 10)) }).unwrap();
                ask(keys::weights_at(&run, ENDLESS.eval_interval), question).await;
            }
            Attack::Subscriptions => {
                let number = subscriptions.len();
                for key in [format!("somewhere/{number}"), matches_weights(number)] {
                    subscriptions.push(session.declare_subscriber(key).callback(drop).await.unwrap());
                }
                if subscriptions.len() > 1000 {
                    subscriptions.clear();
                }
            }
            Attack::Tokens => {
                let number = tokens.len() as u64;
                let evaluator = keys::live_evaluator(&run, &name(&format!("flood-{number}")));
                for key in [evaluator, keys::live_learner(&run, number), format!("somewhere/{number}")] {
                    tokens.push(session.liveliness().declare_token(key).await.unwrap());
                }
                if tokens.len() > 1000 {
                    tokens.clear();
                }
            }
            Attack::Evaluators => {
                let evaluator = format!("flood-{}", tokens.len());
                let token = keys::live_evaluator(&run, &name(&evaluator));
                tokens.push(session.liveliness().declare_token(token).await.unwrap());
                ask(keys::jobs(&run), claim_of(&evaluator)).await;
                if tokens.len() > 1000 {
                    tokens.clear();
                }
            }
            Attack::Connections | Attack::ReadsNothing | Attack::Pieces => unreachable!("they need no session"),
        }
        tokio::task::yield_now().await;
    }
}

/// Asks for weights again and again, and then reads nothing: the process stops itself.
async fn read_nothing(endpoint: &str) {
    let session = open(endpoint).await;
    let question = encode(&WeightsRequest { evaluator: name("silent") }).unwrap();
    for _ in 0..300 {
        let get = session.get(keys::weights_at(&run(), ENDLESS.eval_interval)).payload(question.clone());
        get.timeout(PATIENCE).callback(drop).await.unwrap();
    }
    let stop = format!("kill -STOP {}", std::process::id());
    Command::new("sh").args(["-c", &stop]).status().unwrap();
}

/// A learner on one core, and five evaluators that work for it.
struct Scene {
    learner: Learner,
    endpoint: String,
    crowd: Crowd,
    _runtime: Runtime,
    _router: Option<Session>,
    scratch: Scratch,
}

impl Scene {
    /// They meet at the learner.
    fn direct() -> Scene {
        let (scratch, runtime) = (Scratch::new(), Runtime::new().unwrap());
        let learner = on_core(1, || scratch.learner("run", ENDLESS));
        Self::begin(scratch, runtime, learner.endpoint(), learner, None)
    }

    /// They meet at a router, as Docker Compose starts it, that shares a core with the stranger.
    fn behind_a_router() -> Scene {
        let (scratch, runtime) = (Scratch::new(), Runtime::new().unwrap());
        let endpoint = format!("tcp/127.0.0.1:{}", free_port());
        let router = runtime.block_on(router(&endpoint));
        let learner = on_core(1, || scratch.learner_with("run", ENDLESS, &["--connect", &endpoint]));
        Self::begin(scratch, runtime, endpoint, learner, Some(router))
    }

    fn begin(scratch: Scratch, runtime: Runtime, endpoint: String, learner: Learner, router: Option<Session>) -> Scene {
        learner.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
        let crowd = runtime.block_on(Crowd::connect(HONEST, &run(), &endpoint));
        crowd.set(Pace::Quick);
        Scene { learner, endpoint, crowd, _runtime: runtime, _router: router, scratch }
    }

    /// Lets the stranger try one after the other.
    fn bears(mut self, attacks: &[Attack]) {
        let (phase, rounds) = (Duration::from_secs(number("QUAD_SECONDS", 1)), number("QUAD_ROUNDS", 1) as usize);
        let quiet_memory = self.learner.process.peak_memory().unwrap();
        let (mut shares, mut taken) = (Vec::new(), Vec::new());
        for &attack in attacks {
            let mut stranger = None;
            self.crowd.measured();
            let [quiet, loud] = compare(&self.learner, rounds, phase, |loud| {
                stranger = loud.then(|| start_stranger(attack, &self.endpoint, self.scratch.path()));
            });
            // Nobody is served less than before: whoever has waited gets an answer.
            let claims = eventually("claims are answered", PATIENCE, || {
                let claims = self.crowd.measured().claims;
                (!claims.is_empty()).then_some(claims)
            });
            let slowest = *claims.iter().max().unwrap();
            // Where no firewall is loaded, new connections are before everybody.
            let bearable = slowest < Duration::from_secs(4) || matches!(attack, Attack::Connections);
            assert!(bearable, "{attack:?}: a claim waited {slowest:.1?}");
            let share = loud.steps_per_second / quiet.steps_per_second;
            let threads = loud.other_threads - quiet.other_threads;
            eprintln!("{attack:?}: training at {share:.3}, {threads:.3} s/s besides, slowest claim {slowest:.1?}");
            shares.push(share);
            taken.push(threads);
        }
        // Nothing of them is left behind.
        let begin = Instant::now();
        self.crowd.measured();
        eventually("claims are answered again", PATIENCE, || (!self.crowd.measured().claims.is_empty()).then_some(()));
        eprintln!("all attacks are over: a claim was answered within {:.1?}", begin.elapsed());
        // Training hardly notices them, although it has to share its core.
        let taken = median(taken.into_iter());
        assert!(taken < 0.05, "most attacks take {taken:.3} s of processor time a second");
        assert!(median(shares.iter().copied()) > 0.7, "training at {shares:.2?}");
        let growth = self.learner.process.peak_memory().unwrap().saturating_sub(quiet_memory) >> 20;
        let page = http::metrics(&self.learner.metrics()).unwrap();
        let rejected = page.lines().filter(|line| line.starts_with("quad_learner_rejected"));
        eprintln!("memory: at most {growth} MiB more\n{}", rejected.collect::<Vec<_>>().join("\n"));
        assert!(growth < 200, "the attacks took {growth} MiB");
        assert!(self.learner.process.is_running());
    }
}

#[test]
fn whatever_strangers_do_the_work_goes_on() {
    if let Ok(what) = std::env::var(STRANGER) {
        return be_a_stranger(&what);
    }
    on_core(0, || {
        eprintln!("at a learner that listens");
        Scene::direct().bears(&ATTACKS);
        eprintln!("at its router");
        // A router keeps pieces for as long as their sender is there.
        Scene::behind_a_router().bears(&ATTACKS[..ATTACKS.len() - 1]);
    });
}
