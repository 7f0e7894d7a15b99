//! Peers that read nothing, and another learner of the same name.

use quad_protocol::Snapshot;

use super::*;

/// Asks for weights again and again, wants all that is published, and then reads nothing: the process stops itself.
async fn reads_nothing(endpoint: String) {
    let endpoints = Endpoints { connect: vec![endpoint], ..Endpoints::default() };
    let session = open_session(&endpoints).await.unwrap();
    let _all = session.declare_subscriber("quad/bench/**").callback(drop).await.unwrap();
    let _token =
        session.liveliness().declare_token(keys::live_evaluator(&name("bench"), &name("stranger"))).await.unwrap();
    for _ in 0..150 {
        let key = keys::weights_at(&name("bench"), 10);
        session.get(key).timeout(PATIENCE).callback(drop).await.unwrap();
    }
    let stop = format!("kill -STOP {}", std::process::id());
    std::process::Command::new("sh").args(["-c", &stop]).status().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_peer_that_reads_nothing_holds_up_neither_jobs_nor_snapshots() {
    const STRANGER: &str = "QUAD_TEST_STRANGER";
    if let Ok(endpoint) = std::env::var(STRANGER) {
        return reads_nothing(endpoint).await;
    }
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    let mut command = std::process::Command::new(std::env::current_exe().unwrap());
    command
        .args(["--exact", "live::tests::peers::a_peer_that_reads_nothing_holds_up_neither_jobs_nor_snapshots"])
        .env(STRANGER, &bench.endpoint);
    let mut stranger = command.stdout(std::process::Stdio::null()).spawn().unwrap();
    let state = || std::fs::read_to_string(format!("/proc/{}/stat", stranger.id())).unwrap();
    let start = Instant::now();
    while !state().contains(") T ") {
        assert!(start.elapsed() < PATIENCE, "{}", state());
        tokio::time::sleep(Duration::from_millis(5)).await;
    }

    // Until the learner has closed the connection; the stranger itself does nothing any more.
    let (start, mut step, mut there) = (Instant::now(), 10, true);
    while there {
        assert!(start.elapsed() < PATIENCE, "the stranger is still connected");
        claim(&client, &bench.run, "a").await.expect("always the same job");
        step += 10;
        bench.snapshot(step).await;
        let snapshot: Snapshot = ask(&client, keys::weights_at(&bench.run, step), None).await.unwrap().unwrap();
        assert_eq!(snapshot.step, step);
        there = !bench.coordinator.tick().iter().any(|told| told.contains("stranger has left"));
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    assert!(state().contains(") T "), "{}", state());
    stranger.kill().unwrap();
    stranger.wait().unwrap();
}

/// Other tokens, however many, do not keep it from being noticed.
#[tokio::test(flavor = "multi_thread")]
async fn an_earlier_learner_of_the_same_name_ends_the_run() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    let mut tokens = Vec::new();
    for number in 0..1500 {
        let evaluator = keys::live_evaluator(&bench.run, &name(&format!("e-{number}")));
        tokens.push(client.liveliness().declare_token(evaluator).await.unwrap());
    }
    let _later = client.liveliness().declare_token(keys::live_learner(&bench.run, INCARNATION + 1)).await.unwrap();
    let _earlier = client.liveliness().declare_token(keys::live_learner(&bench.run, INCARNATION - 1)).await.unwrap();
    let event = bench.until(|event| matches!(event, Event::Failed(_))).await;
    let Event::Failed(error) = event else { panic!("{event:?}") };
    assert!(error.to_string().contains("another learner of run bench (incarnation 4, this one is 5)"), "{error}");
    assert!(bench.rejected("too_many_evaluators") > 400);
}
