//! Reports are taken in, or refused and counted.

use std::time::Duration;

use quad_learner::notice::Notice;
use quad_learner::publisher;
use quad_protocol::{CannotAct, Hash, JobReply, RecordedScores, ScoreReply, ScoreReport, decode, encode, keys};

use crate::bench::{Bench, INCARNATION, PATIENCE, ask, claim_eventually, claim_message, deliver, file};
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
async fn a_policy_that_cannot_act_ends_the_run_with_the_reason() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    bench.snapshot(1000).await;
    let job = claim_eventually(&client, &bench.run, "a").await;
    let reason = "a value of a candidate is not a number (NaN)".to_owned();
    let complaint = CannotAct::signed(reason, job.weights, &job.lease);
    let forged = CannotAct { proof: Hash::of(b"guessed"), ..complaint.clone() };
    let broken = ScoreReport { episodes: Vec::new(), cannot_act: Some(complaint), ..full_report(&job, "a") };
    let stranger = ScoreReport { cannot_act: Some(forged), ..broken.clone() };
    assert!(matches!(deliver(&client, &stranger).await, ScoreReply::Refused { .. }), "it has not the job's lease");
    assert_eq!(bench.rejected("wrong_proof"), 1);
    deliver(&client, &broken).await;
    bench.until(|notice| matches!(notice, Notice::Failed(error) if error.to_string().contains("step 1000 cannot act: a value")))
        .await;
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
        assert!(ask::<JobReply>(&client, key, Some(vec![0; 1 << 20])).await.unwrap().is_err());
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
    let mut bench = Bench::with_lease(PATIENCE).await;
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
