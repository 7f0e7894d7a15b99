//! Messages in pieces. Zenoh keeps each piece until the last one has come, and with it the whole buffer of 64 KiB that it was
//! received in, however small it is; nobody but Zenoh hears of a message that never ends.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::time::Duration;

use quad_protocol::keys;
use quad_tests::made_up::name;
use quad_tests::pieces::{Pieces, publication};
use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, number};
use zenoh::Config;

/// Most that a learner's memory may grow by, MiB.
const MOST_GROWTH: u64 = 40;

#[test]
fn a_message_that_never_ends_takes_no_memory_of_a_learner_that_listens() {
    let count = number("QUAD_PIECES", 20_000);
    let scratch = Scratch::new();
    let setting = Setting { steps: 40, eval_interval: 10, ..Setting::default() };
    let mut learner = scratch.learner("run", setting);
    let endpoint = learner.endpoint();
    learner.process.wait_for_log("training is done", PATIENCE);
    for size in [0, 1, 1000, 32_000] {
        let quiet = learner.process.peak_memory().unwrap();
        let mut stranger = Pieces::connect(&endpoint);
        (0..count).for_each(|_| stranger.piece(&vec![0x1d; size], false));
        stranger.leave();
        let growth = learner.process.peak_memory().unwrap().saturating_sub(quiet) >> 20;
        eprintln!("{count} pieces of {size} bytes: {growth} MiB");
        assert!(growth < MOST_GROWTH, "{count} pieces of {size} bytes took {growth} MiB");
    }
    let _evaluator = scratch.evaluator("steady", &endpoint);
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&setting);
}

/// So that the test above is about what it says.
#[tokio::test(flavor = "multi_thread")]
async fn whoever_takes_messages_in_pieces_gets_them_whole() {
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let mut config = Config::default();
    config.insert_json5("listen/endpoints", &format!("[{endpoint:?}]")).unwrap();
    config.insert_json5("scouting/multicast/enabled", "false").unwrap();
    let session = zenoh::open(config).await.unwrap();
    let key = keys::progress(&name("run"), &name("stranger"));
    let subscriber = session.declare_subscriber(&key).await.unwrap();
    let message = publication(&key, b"in pieces");
    let send = move || {
        let mut stranger = Pieces::connect(&endpoint);
        let (last, first) = message.split_last().unwrap();
        first.iter().for_each(|&byte| stranger.piece(&[byte], false));
        stranger.piece(&[*last], true);
        stranger.leave();
    };
    tokio::task::spawn_blocking(send).await.unwrap();
    let sample = tokio::time::timeout(Duration::from_secs(20), subscriber.recv_async()).await.unwrap().unwrap();
    assert_eq!(sample.payload().to_bytes(), &b"in pieces"[..]);
}
