//! A disk that hangs or refuses what is to be kept.

use super::*;
use crate::evaluation::tests::full_report;

#[tokio::test(flavor = "multi_thread")]
async fn while_scores_cannot_be_written_jobs_go_out_and_no_score_is_acknowledged_or_lost() {
    let mut bench = Bench::with_lease(LEASE).await;
    let client = bench.client().await;
    bench.snapshot(10).await;
    bench.snapshot(20).await;
    let disk = bench.disk.clone();
    let hanging = disk.lock().await;
    let mut delivered = Vec::new();
    for evaluator in ["a", "b", "c"] {
        let job = claim_eventually(&client, &bench.run, evaluator).await;
        // Each twice, as an evaluator does that waits for long.
        for _ in 0..2 {
            let (client, report) = (client.clone(), full_report(&job, evaluator));
            delivered.push(tokio::spawn(async move { deliver(&client, &report).await }));
        }
    }
    tokio::time::sleep(LEASE / 2).await;
    assert!(delivered.iter().all(|delivered| !delivered.is_finished()), "acknowledged before it was on the disk");
    assert_eq!(bench.lines(), 0);
    drop(hanging);
    let mut new = 0;
    for delivered in delivered {
        let ScoreReply::Recorded { new: of_this, .. } = delivered.await.unwrap() else { panic!("refused") };
        new += of_this;
    }
    assert_eq!((bench.lines(), new, bench.metrics.evaluation.scores_duplicate.get()), (6, 6, 6));
}

/// A full disk, and many evaluators that report together. That each keeps its job is tested with the scoreboard.
#[tokio::test(flavor = "multi_thread")]
async fn every_evaluator_hears_why_its_scores_could_not_be_saved() {
    let full = |log: &mut Log| *log = Log::unchecked("/dev/full".into()).unwrap();
    let mut bench = Bench::with(Duration::from_secs(600), full).await;
    let client = bench.client().await;
    let mut answers = Vec::new();
    for (number, step) in (0..200).zip((10..).flat_map(|step| [step; 2])) {
        if bench.coordinator.weights(step).is_none() {
            bench.snapshot(step).await;
        }
        let evaluator = format!("e-{number}");
        let report = full_report(&claim_eventually(&client, &bench.run, &evaluator).await, &evaluator);
        let (client, key, report) = (client.clone(), keys::scores(&bench.run), encode(&report).unwrap());
        answers.push(async move { ask::<ScoreReply>(&client, key, Some(report)).await });
    }
    let answers: Vec<_> = answers.into_iter().map(tokio::spawn).collect();
    for answer in answers {
        let error = answer.await.unwrap().expect("an answer").unwrap_err();
        assert!(error.contains("could not be saved"), "{error}");
    }
    bench.until(|event| matches!(event, Event::DiskTrouble(Saved::Scores, _))).await;
    assert_eq!(bench.metrics.disk.trouble(Saved::Scores).get(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_is_published_before_it_is_written() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    let published = client.declare_subscriber(keys::weights(&bench.run)).await.unwrap();
    let folder = bench.run_dir.path().join("snapshots");
    std::fs::remove_dir(&folder).unwrap();
    std::fs::write(&folder, "in the way").unwrap();
    bench.train(10);
    bench.until(|event| matches!(event, Event::DiskTrouble(Saved::Run, _))).await;
    assert!(claim(&client, &bench.run, "a").await.is_none());
    assert!(published.try_recv().unwrap().is_none());
    std::fs::remove_file(&folder).unwrap();
    bench.until(|event| matches!(event, Event::Published { step: 10 })).await;
    assert_eq!(bench.run_dir.read_snapshot(10).unwrap(), file(10));
    claim(&client, &bench.run, "a").await.expect("there is work");
}

/// A run without its folder ends: to try again would never help.
#[tokio::test(flavor = "multi_thread")]
async fn a_run_whose_folder_is_removed_ends() {
    let mut bench = Bench::start().await;
    std::fs::remove_dir_all(bench.run_dir.path()).unwrap();
    bench.train(10);
    let event = bench.until(|event| matches!(event, Event::Failed(_) | Event::Published { .. })).await;
    let Event::Failed(error) = event else { panic!("{event:?}") };
    assert!(error.to_string().contains("removed"), "{error}");
}
