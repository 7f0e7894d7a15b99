//! Floods: one client sends as much as its connection takes. The learner's memory is bounded, and
//! evaluators are served meanwhile.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

use quad_protocol::{Name, encode, keys};
use quad_tests::made_up::{self, name};
use quad_tests::setting::{ENDLESS, Setting};
use quad_tests::system::Scratch;
use quad_tests::{PATIENCE, eventually};
use zenoh::Session;

/// Most that a learner's memory may grow by, MiB.
const MOST_GROWTH: u64 = 150;
/// The first step that is evaluated.
const STEP: u64 = 5000;
/// Messages of a flood, at least, however busy the machine is.
const LEAST_MESSAGES: u64 = 100;
/// Most tokens of one client at a time.
const MOST_TOKENS: usize = 1000;

#[derive(Clone, Copy, Debug)]
enum Flood {
    Progress,
    Claims,
    /// Scores whose return is not a number.
    Reports,
    /// Messages of another version of the protocol, and noise.
    Garbage,
    /// Messages that are larger than any of their kind, in each part of a query.
    Large,
    /// Evaluators that come, ask for work and leave.
    Evaluators,
    /// Requests for weights.
    Downloads,
}

/// A client that sends without a pause.
struct Client {
    session: Session,
    run: Name,
    tokens: Vec<zenoh::liveliness::LivelinessToken>,
}

impl Client {
    async fn ask(&self, key: &str, question: Vec<u8>) {
        let get = self.session.get(key).payload(question).timeout(Duration::from_secs(1));
        get.callback(drop).await.unwrap();
    }

    async fn ask_much(&self, key: &str) {
        let (much, claim) = ("x".repeat(100_000), claim("flood"));
        let ask =
            |key: String| self.session.get(key).timeout(Duration::from_secs(1)).callback(drop);
        ask(format!("{key}?{much}")).payload(claim.clone()).await.unwrap();
        ask(key.to_owned()).payload(claim.clone()).attachment(&much).await.unwrap();
        ask(key.to_owned()).payload(claim).encoding("text/plain;much").await.unwrap();
        ask(key.to_owned()).payload(vec![0; 1_000_000]).await.unwrap();
    }

    /// Sends the next message or two.
    async fn send(&mut self, flood: Flood, number: u64) {
        let run = self.run.clone();
        let told = keys::progress(&run, &name("flood"));
        match flood {
            Flood::Progress => {
                let progress = encode(&made_up::progress(&run, "flood", number)).unwrap();
                self.session.put(&told, progress).await.unwrap();
                self.session.delete(&told).await.unwrap();
            }
            Flood::Claims => self.ask(&keys::jobs(&run), claim(&format!("flood-{number}"))).await,
            Flood::Reports => {
                let report = encode(&made_up::report(&run, STEP, number)).unwrap();
                self.ask(&keys::scores(&run), report).await;
            }
            Flood::Garbage => {
                let mut newer = claim("flood");
                newer[4] ^= 0xff;
                self.session.put(&told, number.to_le_bytes().repeat(100)).await.unwrap();
                self.ask(&keys::jobs(&run), newer).await;
            }
            Flood::Large => self.ask_much(&keys::jobs(&run)).await,
            Flood::Evaluators => {
                let evaluator = format!("flood-{number}");
                let token = keys::live_evaluator(&run, &name(&evaluator));
                self.tokens.push(self.session.liveliness().declare_token(token).await.unwrap());
                self.ask(&keys::jobs(&run), claim(&evaluator)).await;
                if self.tokens.len() > MOST_TOKENS {
                    self.tokens.clear();
                }
            }
            Flood::Downloads => self.ask(&keys::weights_at(&run, STEP), Vec::new()).await,
        }
    }
}

fn claim(evaluator: &str) -> Vec<u8> {
    encode(&made_up::claim(evaluator, 1, "moon")).unwrap()
}

/// Begins to send, until told to stop and all that a flood is are sent.
async fn start(flood: Flood, endpoint: &str, stop: Arc<AtomicBool>) -> tokio::task::JoinHandle<()> {
    let mut client =
        Client { session: made_up::client(endpoint).await, run: name("run"), tokens: Vec::new() };
    tokio::spawn(async move {
        let mut number = 0;
        while !stop.load(Relaxed) || number < LEAST_MESSAGES {
            number += 1;
            client.send(flood, number).await;
            tokio::task::yield_now().await;
        }
    })
}

/// Lets a learner that listens bear each flood for so long.
async fn bear(each: Duration) {
    let scratch = Scratch::new();
    // Something new to evaluate about every second.
    let learner = scratch.learner("run", Setting { eval_interval: STEP, episodes: 400, ..ENDLESS });
    let endpoint = learner.endpoint();
    let evaluator = scratch.evaluator("steady", &endpoint);
    learner.wait_for_scores(0);
    let quiet = learner.process.peak_memory().unwrap();
    use Flood::{Claims, Downloads, Evaluators, Garbage, Large, Progress, Reports};
    for flood in [Progress, Claims, Reports, Garbage, Large, Evaluators, Downloads] {
        let stop = Arc::new(AtomicBool::new(false));
        let flooding = start(flood, &endpoint, stop.clone()).await;
        let scores = learner.scores().len();
        tokio::time::sleep(each).await;
        eventually(&format!("there are scores in spite of {flood:?}"), PATIENCE, || {
            (learner.scores().len() > scores).then_some(())
        });
        stop.store(true, Relaxed);
        flooding.await.unwrap();
        let growth = learner.process.peak_memory().unwrap().saturating_sub(quiet) >> 20;
        let scores = learner.scores().len() - scores;
        eprintln!("{flood:?}: memory has grown by {growth} MiB at most, {scores} scores");
        assert!(growth < MOST_GROWTH, "{flood:?} took {growth} MiB");
    }
    let least = LEAST_MESSAGES as f64;
    learner.wait_for_metric("rejected_messages_total", "", |rejected| rejected >= least);
    learner.assert_scores_are_distinct();
    learner.process.assert_not_said("panicked");
    evaluator.process.assert_not_said("panicked");
    // Without those of the evaluations, which are as many as training is fast.
    let lines = learner.process.log().lines().filter(|line| !line.contains("INFO step ")).count();
    assert!(lines < 1000, "{lines} lines in the log");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_second_of_each_flood_takes_bounded_memory() {
    bear(Duration::from_secs(1)).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "three minutes"]
async fn twenty_seconds_of_each_flood_take_bounded_memory() {
    bear(Duration::from_secs(20)).await;
}
