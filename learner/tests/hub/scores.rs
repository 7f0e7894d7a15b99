//! Reports are taken in, or refused and counted.

use std::time::{Duration, Instant};

use quad_learner::hub;
use quad_learner::notice::Notice;
use quad_learner::publisher;
use quad_protocol::{Hash, JobReply, RecordedScores, ScoreReply, ScoreReport, decode, encode, keys};

use crate::bench::{Bench, INCARNATION, LEASE, PATIENCE, ask, claim_eventually, claim_message, deliver, file};
use crate::common::{full_report, name};

#[tokio::test(flavor = "multi_thread")]
async fn a_job_goes_out_and_its_scores_are_on_disk_before_the_thanks() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    let watched = client.declare_subscriber(keys::scores_at(&bench.run, 10)).await.unwrap();
    bench.snapshot(10).await;

    let job = claim_eventually(&client, &bench.run, "a").await;
    assert_eq!((job.step, job.incarnation, job.candidates, job.seeds.len()), (10, INCARNATION, 3, 2));
    assert_eq!(job.weights, Hash::of(&file(10)));

    let recorded = deliver(&client, &full_report(&job, "a")).await;
    assert_eq!(bench.lines(), 2);
    assert!(matches!(recorded, ScoreReply::Recorded { incarnation: INCARNATION, new: 2, duplicates: 0 }));
    let again = deliver(&client, &full_report(&job, "a")).await;
    assert!(matches!(again, ScoreReply::Recorded { new: 0, duplicates: 2, .. }));
    assert_eq!((bench.lines(), bench.metrics.evaluation.scores_duplicate.get()), (2, 2));

    let sample = tokio::time::timeout(PATIENCE, watched.recv_async()).await.unwrap().unwrap();
    let published: RecordedScores = decode(&sample.payload().to_bytes()).unwrap();
    assert_eq!((published.step, published.episodes.len(), published.evaluator), (10, 2, name("a")));

    let rest = claim_eventually(&client, &bench.run, "a").await;
    deliver(&client, &full_report(&rest, "a")).await;
    let Notice::Evaluated { step: 10, scores } = bench.until(|notice| matches!(notice, Notice::Evaluated { .. })).await
    else {
        panic!("another step")
    };
    assert_eq!(scores.len(), 4);
    assert_eq!(bench.metrics.evaluation.step.get(), 10);
    bench.publisher.send(publisher::Event::TrainingCompleted);
    bench.until(|notice| matches!(notice, Notice::Settled)).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn garbage_is_counted_by_reason_and_answered_with_an_error() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    let good = encode(&claim_message("a", 1)).unwrap();
    let mut newer = good.clone();
    newer[4] ^= 0xff;
    for key in [keys::jobs(&bench.run), keys::scores(&bench.run)] {
        for payload in [None, Some(b"GET / HTTP/1.1".to_vec()), Some(newer.clone()), Some(good[..9].to_vec())] {
            assert!(ask::<JobReply>(&client, key.clone(), payload).await.unwrap().is_err());
        }
        // Not larger: a learner that listens hears of nothing that comes in several pieces.
        assert!(ask::<JobReply>(&client, key, Some(vec![0; 31_000])).await.unwrap().is_err());
    }
    let wrong_kind = ask::<ScoreReply>(&client, keys::scores(&bench.run), Some(good.clone())).await.unwrap();
    assert!(wrong_kind.is_err());
    client.put(keys::progress(&bench.run, &name("a")), "nonsense").await.unwrap();
    for reason in ["empty", "not_quad", "version", "truncated", "oversized", "kind"] {
        assert!(bench.rejected(reason) > 0, "{reason} is not counted");
    }

    let job = claim_eventually(&client, &bench.run, "a").await;
    let wrong = ScoreReport { weights: Hash::of(b"others"), ..full_report(&job, "a") };
    let ScoreReply::Refused { reason, .. } = deliver(&client, &wrong).await else { panic!("accepted") };
    assert!(reason.contains("other weights"), "{reason}");
    assert_eq!((bench.rejected("unknown_weights"), bench.lines()), (1, 0));
    assert!(matches!(deliver(&client, &full_report(&job, "a")).await, ScoreReply::Recorded { new: 2, .. }));
}

#[tokio::test(flavor = "multi_thread")]
async fn while_the_disk_hangs_jobs_go_out_and_scores_wait_to_be_written_together() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    bench.snapshot(20).await;
    bench.snapshot(30).await;
    let disk = bench.disk.clone();
    let hanging = disk.lock().await;
    let mut delivered = Vec::new();
    for evaluator in ["a", "b", "c", "d"] {
        let job = claim_eventually(&client, &bench.run, evaluator).await;
        let (asker, report) = (client.clone(), full_report(&job, evaluator));
        delivered.push(tokio::spawn(async move { deliver(&asker, &report).await }));
        // The first is being written before the others come.
        tokio::time::sleep(Duration::from_millis(100)).await;
        if evaluator == "d" {
            let echo = encode(&full_report(&job, "e")).unwrap();
            let error = ask::<ScoreReply>(&client, keys::scores(&bench.run), Some(echo)).await.unwrap().unwrap_err();
            assert!(error.contains("being written"), "{error}");
        }
    }
    claim_eventually(&client, &bench.run, "f").await;
    assert_eq!(bench.lines(), 0);
    assert!(delivered.iter().all(|delivered| !delivered.is_finished()), "thanks before the scores are on the disk");
    drop(hanging);
    for delivered in delivered {
        assert!(matches!(delivered.await.unwrap(), ScoreReply::Recorded { new: 2, duplicates: 0, .. }));
    }
    assert_eq!((bench.lines(), *disk.lock().await), (8, 2), "lines, writes");
}

/// An evaluator that has done its job keeps it, for as long as it asks, though another one would be lost after this lease.
#[tokio::test(flavor = "multi_thread")]
async fn while_scores_cannot_be_saved_their_job_is_not_lost() {
    let mut bench = Bench::with_lease(LEASE).await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    let job = claim_eventually(&client, &bench.run, "a").await;
    let report = full_report(&job, "a");
    let disk = bench.disk.clone();
    let hanging = disk.lock().await;
    let message = encode(&report).unwrap();
    let first = client.get(keys::scores(&bench.run)).payload(message.clone()).timeout(2 * PATIENCE).await.unwrap();
    let begin = Instant::now();
    while begin.elapsed() < 2 * LEASE {
        let again = ask::<ScoreReply>(&client, keys::scores(&bench.run), Some(message.clone())).await.unwrap();
        assert!(again.unwrap_err().contains("being written"));
        tokio::time::sleep(LEASE / 30).await;
    }
    assert_eq!(bench.metrics.evaluation.jobs_expired.get(), 0);
    drop(hanging);
    let reply = first.recv_async().await.unwrap().into_result().unwrap();
    let reply = decode::<ScoreReply>(&reply.payload().to_bytes()).unwrap();
    assert!(matches!(reply, ScoreReply::Recorded { new: 2, .. }), "{reply:?}");
    assert_eq!(bench.metrics.evaluation.jobs_completed.get(), 1);
}

/// They come back in a moment, as after a restart of the learner or of its router.
#[tokio::test(flavor = "multi_thread")]
async fn the_last_audits_are_waited_for_though_nobody_is_there() {
    let mut bench = Bench::with(PATIENCE, 1.0).await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    for _ in 0..2 {
        let job = claim_eventually(&client, &bench.run, "a").await;
        deliver(&client, &full_report(&job, "a")).await;
    }
    bench.hub.send(hub::Event::TrainingCompleted);
    bench.until(|notice| matches!(notice, Notice::Trained { pending: 0 })).await;
    assert_eq!(bench.metrics.evaluators.present.get(), 0, "without a token, nobody is seen");
    let early = tokio::time::timeout(Duration::from_secs(1), bench.until(|notice| matches!(notice, Notice::Settled)));
    assert!(early.await.is_err(), "the audits are not waited for");
    for _ in 0..2 {
        let job = claim_eventually(&client, &bench.run, "b").await;
        deliver(&client, &full_report(&job, "b")).await;
    }
    bench.until(|notice| matches!(notice, Notice::Settled)).await;
    assert_eq!(bench.metrics.evaluation.audits(true).get(), 4);
}
