//! However much strangers send, a learner's memory is bounded, and its run completes.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use quad_protocol::{Name, encode, keys};
use quad_tests::made_up::{self, name};
use quad_tests::router::router;
use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http};
use zenoh::Session;

/// A flood is no measure of a learner while another one trains on every core.
static CORES: tokio::sync::Mutex<()> = tokio::sync::Mutex::const_new(());
/// Most that a learner's memory may grow by, MiB.
const MOST_GROWTH: u64 = 40;

/// Asks for work that there is not.
fn claim(number: u64) -> Vec<u8> {
    encode(&made_up::claim(&format!("flood-{number}"), number, "moon")).unwrap()
}

/// Messages that a learner can read, as fast as they can be sent, and evaluators that come and go.
async fn messages(session: &Session, run: &Name, stop: &AtomicBool) {
    let mut number = 0;
    let mut tokens = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        number += 1;
        let evaluator = format!("flood-{number}");
        let progress = encode(&made_up::progress(run, &evaluator, number)).unwrap();
        session.put(keys::progress(run, &name("flood")), progress).await.unwrap();
        let report = encode(&made_up::report(run, 10 + number % 2, number)).unwrap();
        for (key, message) in [(keys::jobs(run), claim(number)), (keys::scores(run), report)] {
            session.get(key).payload(message).timeout(Duration::from_secs(30)).callback(drop).await.unwrap();
        }
        let token = keys::live_evaluator(run, &name(&evaluator));
        tokens.push(session.liveliness().declare_token(token).await.unwrap());
        // More than a learner counts. Each costs Zenoh more, the more there are.
        if tokens.len() >= 1200 {
            tokens.clear();
        }
        // Without it, a test that fails would not end.
        tokio::task::yield_now().await;
    }
}

/// Questions with more than a message, each of which would have to be kept until it is answered.
async fn large_questions(session: &Session, run: &Name, stop: &AtomicBool) {
    let much = "x".repeat(100_000);
    let mut number = 0;
    while !stop.load(Ordering::Relaxed) {
        for key in [keys::jobs(run), keys::scores(run), keys::weights_at(run, 10)] {
            number += 1;
            let ask = |key: String| session.get(key).timeout(Duration::from_secs(30)).callback(drop);
            ask(format!("{key}?{much}")).payload(claim(number)).await.unwrap();
            ask(key.clone()).payload(claim(number)).attachment(&much).await.unwrap();
            ask(key.clone()).payload(claim(number)).encoding(format!("text/plain;{number}")).await.unwrap();
            ask(key.clone()).payload(&much).await.unwrap();
            ask(key.clone()).payload(vec![0; 1_000_000]).await.unwrap();
        }
        tokio::task::yield_now().await;
    }
}

/// Runs a learner beside a flood, until it counts a hundred messages for each of `reasons` and then its run is complete.
async fn survives<F>(reasons: &[&str], flood: impl FnOnce(Session, Name, Arc<AtomicBool>) -> F)
where
    F: Future<Output = ()> + Send + 'static,
{
    let _alone = CORES.lock().await;
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let setting = Setting { steps: 40, eval_interval: 10, ..Setting::default() };
    let mut learner = scratch.learner_with("run", setting, &["--connect", &endpoint]);
    learner.process.wait_for_log("training is done", PATIENCE);
    let quiet = learner.process.peak_memory().unwrap();

    let stop = Arc::new(AtomicBool::new(false));
    let flooding = tokio::spawn(flood(session, name("run"), stop.clone()));
    let page = learner.metrics();
    for reason in reasons {
        eventually(&format!("the learner counts {reason}"), PATIENCE, || {
            let label = format!("reason=\"{reason}\"");
            let page = http::metrics(&page)?;
            (http::sum(&page, "quad_learner_rejected_messages_total", &label) > 100.0).then_some(())
        });
    }
    // Before there is anybody who could bring the run to its end, and as long as it lasts.
    let mut flooded = learner.process.peak_memory().unwrap();
    let evaluator = scratch.evaluator("steady", &endpoint);
    eventually("the run is over", PATIENCE, || {
        flooded = learner.process.peak_memory().unwrap_or(flooded);
        (!learner.process.is_running()).then_some(())
    });
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    drop(evaluator);
    stop.store(true, Ordering::Relaxed);
    flooding.await.unwrap();
    learner.assert_complete(&setting);
    let growth = flooded.saturating_sub(quiet) >> 20;
    assert!(growth < MOST_GROWTH, "the flood took {growth} MiB");
    let lines = learner.process.log().lines().count();
    assert!(lines < 300, "{lines} lines in the log");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flood_of_messages_takes_bounded_memory_and_the_run_completes() {
    let reasons = ["unknown_incarnation", "unknown_weights", "unknown_step"];
    survives(&reasons, |session, run, stop| async move { messages(&session, &run, &stop).await }).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flood_of_large_questions_takes_bounded_memory_and_the_run_completes() {
    survives(&["oversized"], |session, run, stop| async move { large_questions(&session, &run, &stop).await }).await;
}
