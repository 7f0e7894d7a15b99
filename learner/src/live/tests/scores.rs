//! Reports are taken in, or refused and counted.

use super::*;
use crate::evaluation::tests::full_report;

#[tokio::test(flavor = "multi_thread")]
async fn a_job_goes_out_and_its_scores_are_on_disk_before_the_thanks() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    bench.snapshot(10).await;

    let job = claim_eventually(&client, &bench.run, "a").await;
    assert_eq!((job.step, job.incarnation, job.seeds.len()), (10, INCARNATION, 2));
    assert_eq!(job.weights, Hash::of(&file(10)));

    let recorded = deliver(&client, &full_report(&job, "a")).await;
    assert_eq!(bench.lines(), 2);
    assert!(matches!(recorded, ScoreReply::Recorded { incarnation: INCARNATION, new: 2, duplicates: 0 }));
    let again = deliver(&client, &full_report(&job, "a")).await;
    assert!(matches!(again, ScoreReply::Recorded { new: 0, duplicates: 2, .. }));
    assert_eq!((bench.lines(), bench.metrics.evaluation.scores_duplicate.get()), (2, 2));

    let rest = claim_eventually(&client, &bench.run, "a").await;
    deliver(&client, &full_report(&rest, "a")).await;
    let event = bench.until(|event| matches!(event, Event::Evaluated { .. })).await;
    let Event::Evaluated { step: 10, scores } = event else { panic!("{event:?}") };
    assert_eq!(scores.len(), 4);
    assert_eq!(bench.metrics.evaluation.step.get(), 10);
    assert_eq!(bench.coordinator.pending(), 0);
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
