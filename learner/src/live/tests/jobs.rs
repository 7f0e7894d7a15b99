//! Jobs are handed out, held by progress, and taken back.

use quad_protocol::Progress;

use super::*;
use crate::evaluation::tests::{full_report, progress};

/// As the main loop does.
fn keep_ticking(bench: &Bench) -> tokio::task::JoinHandle<()> {
    let coordinator = bench.coordinator.clone();
    tokio::spawn(async move {
        loop {
            coordinator.tick();
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn jobs_of_evaluators_that_die_or_fall_silent_go_to_others() {
    let mut bench = Bench::with_lease(LEASE).await;
    bench.snapshot(10).await;

    let mortal = bench.client().await;
    let _token = mortal.liveliness().declare_token(keys::live_evaluator(&bench.run, &name("mortal"))).await.unwrap();
    let lost = claim_eventually(&mortal, &bench.run, "mortal").await;
    told(&bench, "evaluator mortal is here").await;
    assert_eq!(bench.metrics.evaluators.present.get(), 1);
    mortal.close().await.unwrap();
    told(&bench, "evaluator mortal has left; its 1 unfinished jobs go to others").await;
    let ticking = keep_ticking(&bench);

    // Without a token only the lease tells; progress holds it up.
    let client = bench.client().await;
    let start = Instant::now();
    let silent = claim_eventually(&client, &bench.run, "silent").await;
    assert_eq!(silent.seeds, lost.seeds);
    let working = claim_eventually(&client, &bench.run, "working").await;
    assert!(claim(&client, &bench.run, "a").await.is_none());
    let mut steps = 0;
    let again = loop {
        steps += 1;
        let message = encode(&progress(&working, "working", steps)).unwrap();
        client.put(keys::progress(&bench.run, &name("working")), message).await.unwrap();
        if let Some(job) = claim(&client, &bench.run, "a").await {
            break job;
        }
        assert!(start.elapsed() < PATIENCE);
        tokio::time::sleep(LEASE / 30).await;
    };
    assert_eq!(again.seeds, silent.seeds);
    assert!(start.elapsed() >= LEASE, "the lease was respected");
    assert_eq!(bench.metrics.evaluation.jobs_expired.get(), 2);

    for (job, evaluator) in [(&again, "a"), (&working, "working"), (&silent, "silent")] {
        deliver(&client, &full_report(job, evaluator)).await;
    }
    assert_eq!((bench.lines(), bench.metrics.evaluation.scores_duplicate.get()), (4, 2));
    assert_eq!(bench.coordinator.pending(), 0);
    ticking.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_claim_is_answered_twice_with_one_job_which_can_be_handed_back() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    let job = claim_eventually(&client, &bench.run, "a").await;
    assert_eq!(claim(&client, &bench.run, "a").await.as_ref(), Some(&job));
    assert_eq!(bench.metrics.evaluation.jobs_handed_out.get(), 1);
    let other = ask_for_job(&client, &bench.run, &claim_message("a", 2)).await;
    assert!(matches!(other, JobReply::Wait { incarnation: INCARNATION, .. }), "{other:?}");
    // Perhaps two evaluators have that name, which is said once.
    ask_for_job(&client, &bench.run, &claim_message("a", 3)).await;
    bench.until(|event| matches!(event, Event::SameName(twice) if *twice == name("a"))).await;
    assert!(bench.events.try_recv().is_err());

    let hand_back = |evaluator| JobRequest::HandBack { evaluator: name(evaluator), job: job.id, failed: None };
    for (evaluator, expected) in [("b", false), ("a", true), ("a", false)] {
        let reply = ask_for_job(&client, &bench.run, &hand_back(evaluator)).await;
        assert!(matches!(reply, JobReply::HandedBack { accepted, .. } if accepted == expected), "{reply:?}");
    }
    assert_eq!(bench.metrics.evaluation.jobs_handed_back.get(), 1);
    assert_eq!(claim_eventually(&client, &bench.run, "b").await.seeds, job.seeds);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_that_an_evaluator_could_not_do_goes_to_others_and_its_reason_is_told_once() {
    let mut bench = Bench::with_lease(PATIENCE).await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    let mut seeds = Vec::new();
    for evaluator in ["a", "b"] {
        let Job { id: job, seeds: of_job, .. } = claim_eventually(&client, &bench.run, evaluator).await;
        seeds.push(of_job);
        let reason = format!("the policy\u{1b}[2J cannot act, says {evaluator}\n{}", "x".repeat(10_000));
        let request = JobRequest::HandBack { evaluator: name(evaluator), job, failed: Some(reason) };
        let reply = ask_for_job(&client, &bench.run, &request).await;
        assert!(matches!(reply, JobReply::HandedBack { accepted: true, .. }), "{reply:?}");
    }
    let job = claim_eventually(&client, &bench.run, "c").await;
    assert_eq!(seeds, [job.seeds.clone(), job.seeds]);
    let told = bench.until(|event| matches!(event, Event::JobFailed { .. } | Event::Failed(_))).await;
    let Event::JobFailed { step: 10, evaluator, reason } = told else { panic!("{told:?}") };
    assert_eq!(evaluator, name("a"));
    assert!(reason.starts_with("the policy[2J cannot act, says axxx") && reason.len() == 300, "{reason}");
    assert_eq!(bench.metrics.evaluation.jobs_failed.get(), 2);
    assert!(bench.events.try_recv().is_err(), "the second is not told");
    assert_eq!(bench.coordinator.pending(), 4, "the run continues");
}

#[tokio::test(flavor = "multi_thread")]
async fn progress_that_does_not_advance_or_is_another_evaluators_does_not_hold_a_job() {
    let mut bench = Bench::with_lease(LEASE).await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    let job = claim_eventually(&client, &bench.run, "a").await;
    let hangs = progress(&job, "a", 10);
    let other = Progress { steps_done: 1 << 40, evaluator: name("b"), ..hangs.clone() };
    let (start, ticking) = (Instant::now(), keep_ticking(&bench));
    while bench.metrics.evaluation.jobs_expired.get() == 0 {
        for message in [&hangs, &other] {
            client.put(keys::progress(&bench.run, &name("a")), encode(message).unwrap()).await.unwrap();
        }
        assert!(start.elapsed() < PATIENCE, "the lease never ends");
        tokio::time::sleep(LEASE / 60).await;
    }
    assert!(bench.rejected("wrong_evaluator") > 5 && bench.rejected("not_advanced") > 5);
    ticking.abort();
}

/// Waits until the main loop would say so.
async fn told(bench: &Bench, line: &str) {
    let start = Instant::now();
    while !bench.coordinator.tick().iter().any(|told| told == line) {
        assert!(start.elapsed() < PATIENCE, "never told: {line}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}
