//! Strangers on a network without certificates: what they send is counted, takes bounded memory, and
//! the work goes on.

use std::time::Duration;

use quad_protocol::{encode, keys};
use quad_runtime::open_router;
use quad_tests::made_up::{self, name, put};
use quad_tests::setting::{ENDLESS, Setting};
use quad_tests::system::Scratch;
use quad_tests::{http, wait_until};
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;

const KEYS: &str = "weights weights/1 weights/x jobs scores experience progress/x live/learner x";
/// Most that a learner's memory may grow by, MiB.
const MOST_GROWTH: u64 = 150;

/// Payloads that no receiver may take for a message, derived from a real one.
fn garbage(real: &[u8]) -> Vec<Vec<u8>> {
    let (mut flipped, mut newer) = (real.to_vec(), real.to_vec());
    *flipped.last_mut().unwrap() ^= 1;
    newer[4] ^= 0xff;
    vec![
        Vec::new(),
        b"QUAD".to_vec(),
        b"noise".repeat(200),
        vec![0xff; 100_000],
        real[..real.len() / 2].to_vec(),
        [real, b"more"].concat(),
        flipped,
        newer,
    ]
}

async fn ask(session: &Session, key: &str, payload: &[u8]) {
    let get = session.get(key).payload(payload).timeout(Duration::from_secs(1));
    get.callback(drop).await.unwrap();
}

/// Sends thousands of well-formed messages of two thousand evaluators, whose tokens it returns.
async fn flood(session: &Session, step: u64) -> Vec<LivelinessToken> {
    let run = name("run");
    let [jobs, scores, weights] =
        [keys::jobs(&run), keys::scores(&run), keys::weights_at(&run, step)];
    let mut tokens = Vec::new();
    for number in 0..2000 {
        let evaluator = format!("flood-{number}");
        let claim = encode(&made_up::claim(&evaluator, 1, "moon")).unwrap();
        let progress = encode(&made_up::progress(&run, "flood", number)).unwrap();
        put(session, &keys::progress(&run, name("flood")), &progress).await;
        ask(session, &jobs, &claim).await;
        ask(session, &scores, &encode(&made_up::report(&run, step, number)).unwrap()).await;
        ask(session, &weights, &[]).await;
        let token = keys::live_evaluator(&run, name(&evaluator));
        tokens.push(session.liveliness().declare_token(token).await.unwrap());
        if number % 100 == 0 {
            // Larger than any message of their kind.
            ask(session, &jobs, &[0; 1_000_000]).await;
            ask(session, &format!("{jobs}?{}", "x".repeat(100_000)), &claim).await;
        }
    }
    tokens
}

#[tokio::test(flavor = "multi_thread")]
async fn nonsense_and_floods_are_counted_take_bounded_memory_and_stop_no_work() {
    let scratch = Scratch::new();
    let (session, endpoint) = open_router().await.unwrap();
    let learner = scratch.learner_with("run", ENDLESS, &["--connect", &endpoint]);
    let evaluator = scratch.evaluator("brave", &endpoint);
    learner.wait_for_scores(1);
    let quiet = learner.process.peak_memory();

    let step = learner.scores()[0].step;
    let weights = keys::weights_at(&name("run"), step);
    let reply = session.get(weights).await.unwrap().recv_async().await.unwrap();
    let snapshot = reply.result().unwrap().payload().to_bytes();
    let claim = encode(&made_up::claim("client", 1, "hopper")).unwrap();
    for payload in [garbage(&snapshot), garbage(&claim)].concat() {
        for key in KEYS.split(' ').map(|key| format!("quad/run/{key}")) {
            put(&session, &key, &payload).await;
            ask(&session, &key, &payload).await;
        }
    }
    let _tokens = flood(&session, step).await;

    let page = evaluator.wait_for_address("/metrics");
    wait_until("the evaluator counts weights that are not what they say", || {
        let name = "quad_evaluator_rejected_messages_total";
        let count = |page: String| http::sum(&page, name, "reason=\"hash\"");
        http::metrics(&page).is_some_and(|page| count(page) > 0.0)
    });
    for reason in ["empty", "not_quad", "version", "truncated", "oversized", "kind"] {
        let label = format!("reason=\"{reason}\"");
        learner.wait_for_metric("rejected_messages_total", &label, |count| count > 0.0);
    }
    learner.wait_for_metric("rejected_messages_total", "", |rejected| rejected >= 2000.0);
    learner.wait_for_scores(2 * ENDLESS.episodes as usize);
    let growth = learner.process.peak_memory().saturating_sub(quiet) >> 20;
    assert!(growth < MOST_GROWTH, "memory has grown by {growth} MiB");
    for (process, line) in [
        (&learner.process, "an evaluator gets no job: the message has protocol version"),
        (&evaluator, "ignored a bad snapshot"),
    ] {
        assert_eq!(process.log().matches(line).count(), 1, "it is told once: {line}");
        process.assert_not_said("panicked");
    }
    // Without those of the evaluations, which are as many as training is fast.
    let lines = learner.process.log().lines().filter(|line| !line.contains("INFO step ")).count();
    assert!(lines < 1000, "{lines} lines in the log");
}

/// A frozen evaluator reads nothing of what is sent to it.
#[tokio::test(flavor = "multi_thread")]
async fn a_peer_that_reads_nothing_is_given_up_and_others_are_served() {
    let scratch = Scratch::new();
    // Large snapshots, which fill its connection.
    let learner = scratch.learner("run", Setting { hidden: 256, eval_interval: 100, ..ENDLESS });
    let frozen = scratch.evaluator("frozen", &learner.endpoint());
    learner.process.wait_for_log("evaluator frozen is here");
    frozen.signal("STOP");
    let _evaluator = scratch.evaluator("steady", &learner.endpoint());
    learner.process.wait_for_log("evaluator frozen has left");
    learner.wait_for_scores(2 * ENDLESS.episodes as usize);
}
