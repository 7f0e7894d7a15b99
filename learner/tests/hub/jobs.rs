//! Jobs are handed out, held by progress, and taken back.

use std::time::Instant;

use quad_learner::hub;
use quad_learner::notice::Notice;
use quad_protocol::{Job, JobReply, JobRequest, Lease, Progress, encode, keys};

use crate::bench::{Bench, INCARNATION, LEASE, PATIENCE, ask_for_job, claim, claim_eventually, claim_message, deliver};
use crate::common::{full_report, name, progress};

#[tokio::test(flavor = "multi_thread")]
async fn jobs_of_evaluators_that_die_or_fall_silent_go_to_others() {
    let mut bench = Bench::with_lease(LEASE).await;
    bench.snapshot(10).await;

    let mortal = bench.client().await;
    let _token = mortal.liveliness().declare_token(keys::live_evaluator(&bench.run, &name("mortal"))).await.unwrap();
    let lost = claim_eventually(&mortal, &bench.run, "mortal").await;
    bench.until(|notice| matches!(notice, Notice::EvaluatorJoined(who) if *who == name("mortal"))).await;
    assert_eq!(bench.metrics.evaluators.present.get(), 1);
    mortal.close().await.unwrap();
    let left = bench.until(|notice| matches!(notice, Notice::EvaluatorLeft(..))).await;
    assert!(matches!(left, Notice::EvaluatorLeft(_, 1)), "{left:?}");

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
    bench.hub.send(hub::Event::TrainingCompleted);
    bench.until(|notice| matches!(notice, Notice::Settled)).await;
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

    let hand_back = |lease| JobRequest::HandBack { evaluator: name("a"), job: job.id, lease, failed: None };
    for (lease, expected) in [(Lease::random(), false), (job.lease.clone(), true), (job.lease.clone(), false)] {
        let reply = ask_for_job(&client, &bench.run, &hand_back(lease)).await;
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
        let Job { id: job, lease, seeds: of_job, .. } = claim_eventually(&client, &bench.run, evaluator).await;
        seeds.push(of_job);
        let reason = format!("the policy\u{1b}[2J cannot act, says {evaluator}\n{}", "x".repeat(10_000));
        let request = JobRequest::HandBack { evaluator: name(evaluator), job, lease, failed: Some(reason) };
        let reply = ask_for_job(&client, &bench.run, &request).await;
        assert!(matches!(reply, JobReply::HandedBack { accepted: true, .. }), "{reply:?}");
    }
    let job = claim_eventually(&client, &bench.run, "c").await;
    assert_eq!(seeds, [job.seeds.clone(), job.seeds]);
    let told = bench.until(|notice| matches!(notice, Notice::JobFailed { .. } | Notice::Failed(_))).await;
    let Notice::JobFailed { step: 10, evaluator, reason } = told else { panic!("{told:?}") };
    assert_eq!(evaluator, name("a"));
    assert!(reason.starts_with("the policy[2J cannot act, says axxx") && reason.len() == 300, "{reason}");
    assert_eq!(bench.metrics.evaluation.jobs_failed.get(), 2);
    bench.hub.send(hub::Event::TrainingCompleted);
    let next = bench.until(|notice| !matches!(notice, Notice::EvaluatorJoined(_))).await;
    assert!(matches!(next, Notice::Trained { pending: 4 }), "the second is not told, and the run goes on: {next:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn progress_that_was_heard_or_guessed_does_not_hold_a_job() {
    let mut bench = Bench::with_lease(LEASE).await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    let job = claim_eventually(&client, &bench.run, "a").await;
    let heard = progress(&job, "a", 10);
    let guessed = Progress { steps_done: 1 << 40, ..heard.clone() };
    let start = Instant::now();
    while bench.metrics.evaluation.jobs_expired.get() == 0 {
        for message in [&heard, &guessed] {
            client.put(keys::progress(&bench.run, &name("a")), encode(message).unwrap()).await.unwrap();
        }
        assert!(start.elapsed() < PATIENCE, "the lease never ends");
        tokio::time::sleep(LEASE / 60).await;
    }
    assert!(bench.rejected("wrong_proof") > 5 && bench.rejected("not_advanced") > 5);
}
